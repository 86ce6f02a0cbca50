// Draws a scene by WebGL 2; the order of soft triangles comes from a worker.
"use strict";

// For so many triangles of `texels` each.
function dataTexture(gl, format, count, texels) {
    const texture = gl.createTexture();
    const height = Math.max(1, Math.ceil(count / TRIANGLES_A_ROW));
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("this device cannot hold so many triangles");
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, texels * TRIANGLES_A_ROW, height);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return texture;
}

// Writes RGBA, from the first texel on.
function fillTexture(gl, texture, type, array, texels) {
    gl.bindTexture(gl.TEXTURE_2D, texture);
    const width = texels * TRIANGLES_A_ROW, rows = Math.floor(array.length / (4 * width));
    const whole = 4 * rows * width, rest = (array.length - whole) / 4;
    if (rows) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, rows, gl.RGBA, type, array.subarray(0, whole));
    if (rest) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, rows, rest, 1, gl.RGBA, type, array.subarray(whole));
}

// With three texels a triangle.
function cornerTexture(gl, format, type, array) {
    const texture = dataTexture(gl, format, array.length / 12, 3);
    fillTexture(gl, texture, type, array, 3);
    return texture;
}

// What soft layers are added up in. Many faint ones would be lost in 8 bits, so it is these only where a device has no more. In
// software 32 bits take half the time of 16, which SwiftShader converts to 32 and back at every layer.
function blendedFormat(gl) {
    const info = gl.getExtension("WEBGL_debug_renderer_info");
    const slow16 = info && /SwiftShader/.test(gl.getParameter(info.UNMASKED_RENDERER_WEBGL));
    const float = gl.getExtension("EXT_color_buffer_float");
    const wide = ["EXT_float_blend", "OES_texture_float_linear"].every((name) => gl.getExtension(name));
    if (slow16 && float && wide) return gl.RGBA32F;
    return float || gl.getExtension("EXT_color_buffer_half_float") ? gl.RGBA16F : gl.RGBA8;
}

// A source with constants.
function defined(source, constants) {
    const lines = Object.entries(constants).map(([name, value]) => `#define ${name} ${value}`);
    return source.replace("#version 300 es", ["#version 300 es", ...lines].join("\n"));
}

// A target; made anew when its size changes. `samples` of a pixel; 0 for one without a depth buffer, 1 for one with it.
class GlTarget {
    constructor(gl, format, samples) {
        [this.gl, this.format, this.width, this.height] = [gl, format, 0, 0];
        this.samples = Math.min(samples, gl.getParameter(gl.MAX_SAMPLES));
        [this.shown, this.frame] = [gl.createFramebuffer(), gl.createFramebuffer()];
    }

    get multisampled() {
        return this.samples > 1;
    }

    // Binds it, empty.
    begin(width, height) {
        const { gl } = this;
        if (width !== this.width || height !== this.height) this.resize(width, height);
        this.resume();
        gl.clearColor(0, 0, 0, 0);
        gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    }

    // Binds it with what was drawn.
    resume() {
        const { gl } = this;
        gl.bindFramebuffer(gl.FRAMEBUFFER, this.multisampled ? this.frame : this.shown);
        gl.viewport(0, 0, this.width, this.height);
    }

    resize(width, height) {
        const { gl } = this;
        [this.width, this.height] = [width, height];
        gl.deleteTexture(this.texture);
        for (const buffer of this.buffers || []) gl.deleteRenderbuffer(buffer);
        this.texture = gl.createTexture();
        gl.bindTexture(gl.TEXTURE_2D, this.texture);
        gl.texStorage2D(gl.TEXTURE_2D, 1, this.format, width, height);
        for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
        for (const way of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, way, gl.LINEAR);
        gl.bindFramebuffer(gl.FRAMEBUFFER, this.shown);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.texture, 0);
        const uses = this.samples ? [[gl.DEPTH_COMPONENT24, gl.DEPTH_ATTACHMENT]] : [];
        if (this.multisampled) {
            uses.push([this.format, gl.COLOR_ATTACHMENT0]);
            gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
        }
        this.buffers = uses.map(([format, place]) => {
            const buffer = gl.createRenderbuffer();
            gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
            gl.renderbufferStorageMultisample(gl.RENDERBUFFER, this.multisampled ? this.samples : 0, format, width, height);
            gl.framebufferRenderbuffer(gl.FRAMEBUFFER, place, gl.RENDERBUFFER, buffer);
            return buffer;
        });
    }

    // The texture with what was drawn.
    end() {
        const { gl, width, height } = this;
        if (this.multisampled) {
            gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.frame);
            gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, this.shown);
            gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
        }
        gl.bindFramebuffer(gl.FRAMEBUFFER, null);
        return this.texture;
    }
}

// The canvas as a target, for opaque pictures: what is seen of it is the background where nothing is drawn.
class GlCanvas {
    constructor(gl, background) {
        [this.gl, this.background] = [gl, background];
    }

    begin(width, height) {
        const { gl } = this;
        [this.width, this.height] = [width, height];
        gl.bindFramebuffer(gl.FRAMEBUFFER, null);
        gl.viewport(0, 0, width, height);
        gl.clearColor(...this.background, 1);
        gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    }

    // It needs not be shown.
    end() {
        return null;
    }
}

class GlPainter extends Painter {
    constructor(gl, soup, mesh, arrived) {
        const [whole, small] = [0, 1].map(() => new GlTarget(gl, blendedFormat(gl), 0));
        const [still, moving] = [4, 1].map((samples) => new GlTarget(gl, gl.RGBA8, samples));
        super(gl.canvas, soup, mesh, { whole, small, still, moving, canvas: new GlCanvas(gl, soup.look.background || [0, 0, 0]) });
        [this.gl, this.arrived, this.fence] = [gl, arrived, null];
        const kernel = { KERNEL: KERNEL_IDS[this.look.kernel], SDF: Number(this.look.distance === "sdf") };
        this.soft = compileProgram(gl, defined(SOFT_VERTEX, kernel), defined(SOFT_FRAGMENT, kernel));
        this.opaque = compileProgram(gl, OPAQUE_VERTEX, OPAQUE_FRAGMENT);
        const resolve = (SAMPLES, UNFINISHED) => compileProgram(gl, RESOLVE_VERTEX, defined(RESOLVE_FRAGMENT, { SAMPLES, UNFINISHED }));
        this.resolve = { plain: resolve(1, 0), unfinished: resolve(1, 1), sampled: resolve(STILL_SAMPLES, 0) };
        const places = (...of) => cornerTexture(gl, gl.RGBA32F, gl.FLOAT, packedPlaces(...of));
        this.triangles = { places: places(soup.corners, soup.opacities, soup.sigma), colors: dataTexture(gl, gl.RGBA16F, soup.count, 1) };
        this.solid = mesh && {
            count: mesh.count, places: places(mesh.corners),
            colors: cornerTexture(gl, gl.RGBA8, gl.UNSIGNED_BYTE, packedColors(mesh.colors)),
        };
        this.elements = gl.createBuffer();
        this.sorter = new Sorter(soup, Painter.degreeOf(soup));
        gl.bindVertexArray(gl.createVertexArray());
        gl.disable(gl.DITHER);
    }

    // Gives back what it holds of the scene.
    free() {
        const { gl, triangles, solid } = this;
        for (const texture of [triangles.places, triangles.colors, solid?.places, solid?.colors]) if (texture) gl.deleteTexture(texture);
        gl.deleteBuffer(this.elements);
        this.sorter.end();
        this.arrived = () => {}; // of fewer triangles
    }

    // One order is asked for at a time, then the next one from where the camera is by then. `arrived` is called when it is there.
    order(request) {
        const wanted = JSON.stringify(request);
        if (wanted === this.found) return true;
        if (this.wanted) return false;
        this.wanted = wanted;
        this.asked = this.sorter.sort(request).then((found) => {
            this.take(found);
            [this.found, this.wanted] = [wanted, ""];
            this.arrived();
        });
        return false;
    }

    // What `Sorter` found.
    take({ elements, colors }) {
        const { gl } = this;
        this.ordered(colors.length / 4, elements.length / 3);
        fillTexture(gl, this.triangles.colors, gl.FLOAT, colors, 1);
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.elements);
        gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, elements, gl.DYNAMIC_DRAW);
    }

    mark() {
        const { gl } = this;
        gl.deleteSync(this.fence);
        this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    }

    get done() {
        const { gl } = this;
        return !this.fence || gl.getSyncParameter(this.fence, gl.SYNC_STATUS) === gl.SIGNALED;
    }

    use({ program }, textures) {
        const { gl } = this;
        gl.useProgram(program);
        textures.forEach(([name, texture], place) => {
            gl.activeTexture(gl.TEXTURE0 + place);
            gl.bindTexture(gl.TEXTURE_2D, texture);
            gl.uniform1i(gl.getUniformLocation(program, name), place);
        });
    }

    // A program with triangles, as they are seen in a target.
    aim({ program, at }, { places, colors }, enlarged, camera, { width, height }) {
        const { gl, look } = this;
        this.use({ program }, [["places", places], ["colors", colors]]);
        setCamera(gl, at, camera, camera.lensFor(width, height), [width, height], look.near_plane);
        gl.uniform1f(at.enlarged, enlarged);
    }

    drawSoft(camera, target, from, to) {
        const { gl, soft, look } = this;
        this.aim(soft, this.triangles, this.enlarged, camera, target);
        gl.uniform1f(soft.at.cullLarge, look.cull_large ?? 1e30);
        gl.uniform1f(soft.at.cullSmall, look.cull_small ? 1 : 0);
        gl.enable(gl.BLEND);
        gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE);
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.elements);
        gl.drawElements(gl.TRIANGLES, 3 * (to - from), gl.UNSIGNED_INT, 12 * from);
        gl.disable(gl.BLEND);
    }

    drawOpaque(camera, target) {
        const { gl, opaque, solid } = this;
        this.aim(opaque, solid || this.triangles, solid ? 1 : this.enlarged, camera, target);
        gl.uniform1i(opaque.at.perTriangle, solid ? 3 : 1);
        gl.enable(gl.DEPTH_TEST);
        gl.drawArrays(gl.TRIANGLES, 0, 3 * (solid?.count ?? this.amount));
        gl.disable(gl.DEPTH_TEST);
    }

    // A texture of `samples` times the canvas's size along each side, or of another one, over the texture `below` and the background.
    show(texture, samples, below = null) {
        const { gl, canvas: { width, height } } = this;
        const resolve = this.resolve[below ? "unfinished" : samples > 1 ? "sampled" : "plain"];
        gl.viewport(0, 0, width, height);
        this.use(resolve, [["drawn", texture], ...(below ? [["below", below]] : [])]);
        gl.uniform3fv(resolve.at.background, this.look.background || [0, 0, 0]);
        gl.uniform2f(resolve.at.size, width, height);
        gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
}

// The canvas by WebGL 2. A device takes what it holds from pages that are not looked at for long, and `returned` is called
// when it may be made anew.
class GlDevice {
    constructor(canvas) {
        [this.name, this.returned] = ["WebGL 2", () => {}];
        this.gl = context(canvas, { antialias: false, alpha: false });
        canvas.addEventListener("webglcontextlost", (event) => event.preventDefault()); // so that it comes back
        canvas.addEventListener("webglcontextrestored", () => this.returned());
    }

    get lost() {
        return this.gl.isContextLost();
    }

    painter(soup, mesh, arrived) {
        return new GlPainter(this.gl, soup, mesh, arrived);
    }
}
