// WebGPU: a device for the canvas, and the programs by which a scene is drawn, of the shaders that the page holds as SHADERS.
"use strict";

// Adds up soft layers front to back: what is there is premultiplied and lies before what comes.
const UNDER = { srcFactor: "one-minus-dst-alpha", dstFactor: "one", operation: "add" };
const SOFT_FORMAT = "rgba16float", OPAQUE_FORMAT = "rgba8unorm", DEPTH_FORMAT = "depth24plus";
const GPU_LIMITS = ["maxBufferSize", "maxStorageBufferBindingSize", "maxTextureDimension2D"];

const sourceOf = (...names) => names.map((name) => SHADERS[name]).join("");

class GpuDevice {
    constructor(canvas, soup) {
        [this.canvas, this.look, this.degree] = [canvas, soup.look, Painter.degreeOf(soup)];
        [this.name, this.lost, this.returned] = ["WebGPU", false, () => {}];
        this.most = 4 * Math.max(12, 3 * soup.bases) * soup.whole; // bytes of the largest buffer: corners or harmonics
    }

    // One for the canvas; null where the browser has none of hardware (or of `software`, where that will do) or where it is
    // too small for the scene.
    static async open(canvas, soup, software) {
        const opened = new GpuDevice(canvas, soup);
        if (!await opened.prepare(software)) return null;
        return opened;
    }

    async prepare(software) {
        const adapter = await navigator.gpu?.requestAdapter({ powerPreference: "high-performance" });
        if (!adapter || (!software && adapter.info?.isFallbackAdapter)) return false;
        const { limits } = adapter;
        if (this.most > Math.min(limits.maxBufferSize, limits.maxStorageBufferBindingSize)) return false;
        const device = await adapter.requestDevice({ requiredLimits: Object.fromEntries(GPU_LIMITS.map((name) => [name, limits[name]])) });
        device.addEventListener("uncapturederror", ({ error }) => reportError(new Error(error.message)));
        const format = navigator.gpu.getPreferredCanvasFormat();
        this.programs = await this.compile(device, format);
        [this.device, this.lost] = [device, false];
        this.context = this.canvas.getContext("webgpu");
        this.context.configure({ device, format, alphaMode: "opaque" });
        device.lost.then(async () => {
            this.lost = true;
            if (await this.prepare(software)) this.returned();
        });
        return true;
    }

    // Its programs; throws where a browser does not take one of them.
    async compile(device, format) {
        const { look, degree } = this;
        const shader = (...names) => device.createShaderModule({ code: sourceOf(...names) });
        const compute = (module, entryPoint, constants) => device.createComputePipelineAsync({
            layout: "auto", compute: { module, entryPoint, constants },
        });
        const render = (module, name, target, { samples = 1, vertex = name, constants } = {}) => device.createRenderPipelineAsync({
            layout: "auto",
            vertex: { module, entryPoint: `${vertex}_vertex`, constants: constants?.vertex },
            fragment: { module, entryPoint: `${name}_fragment`, targets: [target], constants: constants?.fragment },
            multisample: { count: samples },
            ...(name === "opaque" && { depthStencil: { format: DEPTH_FORMAT, depthWriteEnabled: true, depthCompare: "less" } }),
        });
        const KERNEL = KERNEL_IDS[look.kernel], SDF = Number(look.distance === "sdf");
        const [sort, scan] = [shader("common", "block_scan", "sort"), shader("block_scan", "scan")];
        const [opaque, colored] = [shader("view", "opaque"), { format: OPAQUE_FORMAT }];
        const solid = (vertex, samples) => render(opaque, "opaque", colored, { vertex, samples });
        const programs = {
            look: compute(shader("view", "order"), "look", { DEGREE: degree }),
            count: compute(sort, "count_digits"),
            scan: compute(scan, "scan"),
            scatter: compute(sort, "scatter"),
            soft: render(shader("view", "soft"), "soft", { format: SOFT_FORMAT, blend: { color: UNDER, alpha: UNDER } },
                { constants: { vertex: { KERNEL, SDF }, fragment: { KERNEL } } }),
            mesh1: solid("mesh", 1), mesh4: solid("mesh", 4), soup1: solid("soup", 1), soup4: solid("soup", 4),
            resolve: render(shader("resolve"), "resolve", { format }),
        };
        return Object.fromEntries(await Promise.all(Object.entries(programs).map(async ([name, program]) => [name, await program])));
    }

    // A buffer that shaders read and write, of so many bytes or of what an array holds.
    storage(content) {
        const { device } = this;
        const size = Math.max(4, content.byteLength ?? content);
        const buffer = device.createBuffer({ size, usage: GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_DST });
        if (content.byteLength) device.queue.writeBuffer(buffer, 0, content);
        return buffer;
    }

    uniform(size) {
        return this.device.createBuffer({ size, usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST });
    }

    // What a program is given, by binding: buffers, parts of them, textures' views, samplers.
    given(program, resources) {
        const entries = Object.entries(resources).map(([binding, resource]) => ({
            binding: Number(binding), resource: resource instanceof GPUBuffer ? { buffer: resource } : resource,
        }));
        return this.device.createBindGroup({ layout: program.getBindGroupLayout(0), entries });
    }

    painter(soup, mesh) {
        return new GpuPainter(this, soup, mesh);
    }
}
