// Draws a scene by WebGPU, which also puts soft triangles into the order of every frame.
"use strict";

const SORT_BLOCK = 2048, SORT_DIGIT = 4; // pairs of a workgroup and bits of a digit in sort.wgsl
const UNIFORM_SLICE = 256; // bytes: where a part of a uniform buffer may begin, everywhere

// A target; `samples` of a pixel, 0 for one without a depth buffer. What `begin` empties is cleared by the next pass.
class GpuTarget {
    constructor(device, format, samples) {
        [this.device, this.format, this.samples, this.width, this.height] = [device, format, samples, 0, 0];
        this.held = [];
    }

    begin(width, height) {
        if (width !== this.width || height !== this.height) this.resize(width, height);
        this.loadOp = "clear";
    }

    resume() {
        this.loadOp = "load";
    }

    resize(width, height) {
        [this.width, this.height] = [width, height];
        for (const texture of this.held) texture.destroy();
        this.held = [];
        const view = (format, sampleCount) => {
            const usage = GPUTextureUsage.RENDER_ATTACHMENT | (sampleCount > 1 || format === DEPTH_FORMAT ? 0 : GPUTextureUsage.TEXTURE_BINDING);
            this.held.push(this.device.createTexture({ size: [width, height], format, sampleCount, usage }));
            return this.held.at(-1).createView();
        };
        this.texture = view(this.format, 1);
        this.many = this.samples > 1 ? view(this.format, this.samples) : null;
        this.depth = this.samples ? view(DEPTH_FORMAT, this.samples) : null;
    }

    // A render pass into it.
    pass(encoder) {
        const { texture, many, depth, loadOp } = this;
        const color = { view: many ?? texture, loadOp, storeOp: many ? "discard" : "store", clearValue: [0, 0, 0, 0] };
        return encoder.beginRenderPass({
            colorAttachments: [many ? { ...color, resolveTarget: texture } : color],
            ...(depth && { depthStencilAttachment: { view: depth, depthLoadOp: "clear", depthStoreOp: "discard", depthClearValue: 1 } }),
        });
    }

    end() {
        return this.texture;
    }
}

class GpuPainter extends Painter {
    constructor(gpu, soup, mesh) {
        const { device } = gpu;
        const [whole, small] = [0, 1].map(() => new GpuTarget(device, SOFT_FORMAT, 0));
        const [still, moving] = [4, 1].map((samples) => new GpuTarget(device, OPAQUE_FORMAT, samples));
        super(gpu.canvas, soup, mesh, { whole, small, still, moving, canvas: moving });
        [this.gpu, this.marked] = [gpu, null];
        const [view, sorting, resolving] = [96, 32 / SORT_DIGIT * UNIFORM_SLICE, 32].map((size) => gpu.uniform(size));
        const pair = () => [4 * soup.count, 4 * soup.count].map((size) => gpu.storage(size));
        this.buffers = {
            view, sorting, resolving,
            places: gpu.storage(packedPlaces(soup.corners, soup.opacities, soup.sigma)),
            harmonics: gpu.storage(soup.harmonics),
            paints: gpu.storage(16 * soup.count),
            starts: gpu.storage(4 * (16 * Math.ceil(soup.count / SORT_BLOCK) + 1)),
            ...(mesh && { meshPlaces: gpu.storage(packedPlaces(mesh.corners)), meshColors: gpu.storage(packedColors(mesh.colors)) }),
        };
        [this.keys, this.triangles] = [pair(), pair()];
        this.sampler = device.createSampler({ magFilter: "linear", minFilter: "linear" });
    }

    // Gives back what it holds of the scene.
    free() {
        for (const buffer of [...Object.values(this.buffers), ...this.keys, ...this.triangles]) buffer.destroy();
        for (const target of Object.values(this.targets)) for (const texture of target.held) texture.destroy();
    }

    // Orders them at once.
    order(request) {
        const wanted = JSON.stringify(request);
        if (wanted === this.found) return true;
        const { gpu: { device, programs }, buffers, keys, triangles } = this;
        const { eye, forward, amount } = request;
        const encoder = device.createCommandEncoder();
        const pass = encoder.beginComputePass();
        const run = (program, groups, given) => {
            pass.setPipeline(programs[program]);
            pass.setBindGroup(0, this.gpu.given(programs[program], given));
            pass.dispatchWorkgroups(groups);
        };
        this.setView({ eye, forward, right: forward, down: forward }, { amount });
        run("look", Math.ceil(amount / 256), {
            0: buffers.view, 1: buffers.places, 2: buffers.harmonics, 3: keys[0], 4: triangles[0], 5: buffers.paints,
        });
        const blocks = Math.ceil(amount / SORT_BLOCK);
        for (let digit = 0; digit < 32 / SORT_DIGIT; ++digit) { // an even number: the first of each pair has the order
            const [here, there, offset] = [digit % 2, 1 - digit % 2, UNIFORM_SLICE * digit];
            device.queue.writeBuffer(buffers.sorting, offset, new Uint32Array([SORT_DIGIT * digit, amount, blocks, 16 * blocks]));
            const step = { buffer: buffers.sorting, offset, size: 16 };
            run("count", blocks, { 0: step, 1: keys[here], 5: buffers.starts });
            run("scan", 1, { 0: step, 1: buffers.starts });
            run("scatter", blocks, {
                0: step, 1: keys[here], 2: triangles[here], 3: keys[there], 4: triangles[there], 5: buffers.starts,
            });
        }
        pass.end();
        device.queue.submit([encoder.finish()]);
        this.ordered(amount, amount);
        this.found = wanted;
        return true;
    }

    mark() {
        const mine = this.marked = {};
        this.gpu.device.queue.onSubmittedWorkDone().then(() => { if (this.marked === mine) this.marked = null; });
    }

    get done() {
        return !this.marked;
    }

    setView({ right, down, forward, eye }, { lens = [0, 0, 0, 0], size = [0, 0], amount = 0, enlarged = 1 }) {
        const { look, soup } = this;
        const data = new Float32Array([
            ...right, look.near_plane, ...down, enlarged, ...forward, look.cull_large ?? 1e30,
            ...eye, look.cull_small ? 1 : 0, ...lens, ...size, 0, 0,
        ]);
        new Uint32Array(data.buffer).set([amount, soup.bases], 22);
        this.gpu.device.queue.writeBuffer(this.buffers.view, 0, data);
    }

    // Triangles `from` to `to` by a program with these buffers.
    drawTriangles(camera, target, name, { given, enlarged, from = 0, to }) {
        const { gpu: { device, programs }, buffers } = this;
        const size = [target.width, target.height];
        this.setView(camera, { lens: camera.lensFor(...size), size, enlarged });
        const encoder = device.createCommandEncoder();
        const pass = target.pass(encoder);
        pass.setPipeline(programs[name]);
        pass.setBindGroup(0, this.gpu.given(programs[name], { 0: buffers.view, ...given }));
        pass.draw(3 * (to - from), 1, 3 * from);
        pass.end();
        device.queue.submit([encoder.finish()]);
    }

    drawSoft(camera, target, from, to) {
        const { enlarged, triangles: [order], buffers: { places, paints } } = this;
        this.drawTriangles(camera, target, "soft", { given: { 1: places, 2: order, 3: paints }, enlarged, from, to });
    }

    drawOpaque(camera, target) {
        const { mesh, amount, enlarged, buffers: { places, paints, meshPlaces, meshColors } } = this;
        const what = mesh ? { given: { 1: meshPlaces, 2: meshColors }, to: mesh.count } : { given: { 1: places, 3: paints }, enlarged, to: amount };
        this.drawTriangles(camera, target, `${mesh ? "mesh" : "soup"}${target.samples}`, what);
    }

    // A texture of `samples` times the canvas's size along each side, or of another one, over the texture `below` and the background.
    show(texture, samples, below = null) {
        const { gpu: { device, context, programs }, buffers: { resolving }, canvas: { width, height } } = this;
        const data = new Float32Array([...(this.look.background || [0, 0, 0]), 0, width, height, 0, 0]);
        const whole = new Uint32Array(data.buffer);
        [whole[3], whole[6]] = [samples, below ? 1 : 0];
        device.queue.writeBuffer(resolving, 0, data);
        const encoder = device.createCommandEncoder();
        const view = context.getCurrentTexture().createView();
        const pass = encoder.beginRenderPass({ colorAttachments: [{ view, loadOp: "clear", storeOp: "store" }] });
        pass.setPipeline(programs.resolve);
        pass.setBindGroup(0, this.gpu.given(programs.resolve, { 0: resolving, 1: texture, 2: below ?? texture, 3: this.sampler }));
        pass.draw(3);
        pass.end();
        device.queue.submit([encoder.finish()]);
    }
}
