// Draws a scene, soft or opaque, at any size: into a target of its own, from there into the canvas.
"use strict";

const TEXTURE_WIDTH = 3072; // a multiple of three, so that a triangle's texels lie in one row
const KERNEL_IDS = { single_sided: 0, bilateral: 1, elastic: 2, hard: 3 };
const STILL_SAMPLES = 2; // along each axis of a pixel of the opaque picture, beside the four of multisampling

function dataTexture(gl, format, texels) {
    const texture = gl.createTexture();
    const height = Math.max(1, Math.ceil(texels / TEXTURE_WIDTH));
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("this device cannot hold so many triangles");
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, TEXTURE_WIDTH, height);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return texture;
}

// Writes `array`, `width` numbers a texel, from the first texel on.
function fillTexture(gl, texture, layout, type, array, width) {
    gl.bindTexture(gl.TEXTURE_2D, texture);
    const rows = Math.floor(array.length / (width * TEXTURE_WIDTH));
    const whole = rows * width * TEXTURE_WIDTH, rest = (array.length - whole) / width;
    if (rows) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_WIDTH, rows, layout, type, array.subarray(0, whole));
    if (rest) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, rows, rest, 1, layout, type, array.subarray(whole));
}

function placesTexture(gl, corners, opacities, sigma) {
    const texels = corners.length / 3;
    const data = new Float32Array(4 * texels);
    for (let i = 0; i < texels; ++i) {
        data.set(corners.subarray(3 * i, 3 * i + 3), 4 * i);
        if (i % 3 === 0) data[4 * i + 3] = opacities ? opacities[i / 3] : 1;
        if (i % 3 === 1 && sigma) data[4 * i + 3] = sigma[(i - 1) / 3];
    }
    const texture = dataTexture(gl, gl.RGBA32F, texels);
    fillTexture(gl, texture, gl.RGBA, gl.FLOAT, data, 4);
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

// Where pictures are drawn before they are shown; made anew when their size changes. `samples` of a pixel; 0 for one
// without a depth buffer, 1 for one with it.
class Target {
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

class Painter {
    // `soup` and `mesh` (or null) are of `readCompact`.
    constructor(gl, soup, mesh) {
        [this.gl, this.soup, this.look] = [gl, soup, soup.look];
        const kernel = `#version 300 es\n#define KERNEL ${KERNEL_IDS[this.look.kernel]}\n#define SDF ${Number(this.look.distance === "sdf")}`;
        const defined = (source) => source.replace("#version 300 es", kernel);
        const [whole, small] = [0, 1].map(() => new Target(gl, blendedFormat(gl), 0));
        this.soft = { ...compileProgram(gl, defined(SOFT_VERTEX), defined(SOFT_FRAGMENT)), whole, small };
        this.opaque = {
            ...compileProgram(gl, OPAQUE_VERTEX, OPAQUE_FRAGMENT),
            still: new Target(gl, gl.RGBA8, 4),
            moving: new Target(gl, gl.RGBA8, 1),
        };
        this.resolve = compileProgram(gl, RESOLVE_VERTEX, RESOLVE_FRAGMENT);
        this.places = placesTexture(gl, soup.corners, soup.opacities, soup.sigma);
        this.colors = dataTexture(gl, gl.RGBA16F, soup.count);
        [this.elements, this.shown, this.drawn, this.enlarged] = [gl.createBuffer(), 0, 0, 1];
        if (mesh) {
            this.mesh = { count: mesh.count, places: placesTexture(gl, mesh.corners), colors: dataTexture(gl, gl.RGBA8, 3 * mesh.count) };
            const colors = new Uint8Array(12 * mesh.count);
            for (let i = 0; i < 3 * mesh.count; ++i) colors.set(mesh.colors.subarray(3 * i, 3 * i + 3), 4 * i);
            fillTexture(gl, this.mesh.colors, gl.RGBA, gl.UNSIGNED_BYTE, colors, 4);
        }
        gl.bindVertexArray(gl.createVertexArray());
        gl.disable(gl.DITHER);
    }

    // Gives back what it holds of the scene.
    free() {
        const { gl, mesh } = this;
        for (const texture of [this.places, this.colors, mesh?.places, mesh?.colors]) if (texture) gl.deleteTexture(texture);
        gl.deleteBuffer(this.elements);
    }

    // What `Sorter` found.
    take({ elements, colors }) {
        const { gl, soup } = this;
        this.enlarged = soup.enlarged[soup.ends.indexOf(colors.length / 4)] ?? 1;
        fillTexture(gl, this.colors, gl.RGBA, gl.FLOAT, colors, 4);
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.elements);
        gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, elements, gl.DYNAMIC_DRAW);
        this.shown = elements.length;
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

    // Elements from `first` to `end`, nearest first, under what `target` has.
    drawSoft(camera, target, first, end) {
        const { gl, soft, look } = this;
        const { width, height } = target;
        this.use(soft, [["places", this.places], ["colors", this.colors]]);
        setCamera(gl, soft.at, camera, camera.lensFor(width, height), [width, height], look.near_plane);
        gl.uniform1f(soft.at.cullLarge, look.cull_large ?? 1e30);
        gl.uniform1f(soft.at.cullSmall, look.cull_small ? 1 : 0);
        gl.uniform1f(soft.at.enlarged, this.enlarged);
        gl.enable(gl.BLEND);
        gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE);
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.elements);
        gl.drawElements(gl.TRIANGLES, end - first, gl.UNSIGNED_INT, 4 * first);
        gl.disable(gl.BLEND);
    }

    // The next `share` of the triangles of the soft picture, which is begun anew where it is `fresh`. Where what is drawn of it
    // is not opaque yet, the picture of the camera in motion is seen through it. Returns whether that was all: then it
    // is the picture of `draw`, to the bit.
    refine(camera, share, fresh) {
        const { gl, shown, soft: { whole, small } } = this;
        if (fresh) {
            whole.begin(gl.canvas.width, gl.canvas.height);
            this.drawn = 0;
        } else {
            whole.resume();
        }
        const end = Math.min(shown, this.drawn + 3 * Math.ceil(share * shown / 3));
        this.drawSoft(camera, whole, this.drawn, end);
        this.drawn = end;
        this.show(whole.end(), 1, end < shown ? small.texture : null);
        return end === shown;
    }

    drawOpaque(camera, width, height, target) {
        const { gl, opaque, mesh } = this;
        target.begin(width, height);
        const { places, colors, count } = mesh || { ...this, count: this.soup.count };
        this.use(opaque, [["places", places], ["colors", colors]]);
        setCamera(gl, opaque.at, camera, camera.lensFor(width, height), [width, height], this.look.near_plane);
        gl.uniform1i(opaque.at.perTriangle, mesh ? 3 : 1);
        gl.enable(gl.DEPTH_TEST);
        gl.drawArrays(gl.TRIANGLES, 0, 3 * count);
        gl.disable(gl.DEPTH_TEST);
        return target.end();
    }

    // A picture of `mode`, "soft" or "opaque", in the canvas. Where it is not `still`, it is drawn `scale` times as large,
    // 1 or less; where it is, an opaque one is drawn with many samples of a pixel.
    draw(camera, mode, { scale = 1, still = true } = {}) {
        const { gl, opaque, soft } = this;
        const { width, height } = gl.canvas;
        if (mode === "soft" && still) { this.refine(camera, 1, true); return; }
        const samples = still ? STILL_SAMPLES : 1;
        const [w, h] = [width, height].map((side) => Math.max(1, Math.round((still ? samples : scale) * side)));
        if (mode === "soft") {
            soft.small.begin(w, h);
            this.drawSoft(camera, soft.small, 0, this.shown);
            this.show(soft.small.end(), 1);
        } else {
            this.show(this.drawOpaque(camera, w, h, still ? opaque.still : opaque.moving), samples);
        }
    }

    // A texture of `samples` times the canvas's size along each side, or of another one, over the texture `below` and the background.
    show(texture, samples, below = null) {
        const { gl, resolve } = this;
        const { width, height } = gl.canvas;
        gl.viewport(0, 0, width, height);
        this.use(resolve, [["drawn", texture], ["below", below ?? texture]]);
        gl.uniform1i(resolve.at.unfinished, below ? 1 : 0);
        gl.uniform3fv(resolve.at.background, this.look.background || [0, 0, 0]);
        gl.uniform2f(resolve.at.size, width, height);
        gl.uniform1i(resolve.at.samples, samples);
        gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
}
