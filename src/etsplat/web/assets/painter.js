// What is drawn of a scene and when, by whatever draws it: GlPainter or GpuPainter, each with
//   order(request)                     whether soft triangles are in the order from there; asks for it where they are not
//   wanted, asked                      the order that was asked for and is not there, in words; the promise of it
//   drawSoft(camera, target, from, to) soft triangles from one place of the order to another, under what the target has
//   drawOpaque(camera, target)         opaque triangles
//   show(texture, samples, below)      a picture in the canvas
//   mark(), done                       a mark in the device's work, and whether it has come so far
// and with targets, where pictures are drawn before they are shown: begin(width, height) empties one, resume() goes on with
// what was drawn, end() is the texture of that, or null where it is seen already.
"use strict";

const KERNEL_IDS = { single_sided: 0, bilateral: 1, elastic: 2, hard: 3 };
const STILL_SAMPLES = 2; // along each axis of a pixel of the opaque picture, beside the four of multisampling

// Four numbers a corner: where it is, and the opacity of its triangle, the softness or nothing.
function packedPlaces(corners, opacities, sigma) {
    const count = corners.length / 3;
    const data = new Float32Array(4 * count);
    for (let i = 0; i < count; ++i) {
        data.set(corners.subarray(3 * i, 3 * i + 3), 4 * i);
        if (i % 3 === 0) data[4 * i + 3] = opacities ? opacities[i / 3] : 1;
        if (i % 3 === 1 && sigma) data[4 * i + 3] = sigma[(i - 1) / 3];
    }
    return data;
}

// RGBA, a byte each, of the corners of opaque triangles.
function packedColors(colors) {
    const packed = new Uint8Array(4 * (colors.length / 3));
    for (let i = 0; i < colors.length / 3; ++i) packed.set(colors.subarray(3 * i, 3 * i + 3), 4 * i);
    return packed;
}

class Painter {
    // `soup` and `mesh` (or null) are of `readCompact`; targets are {whole, small} of soft pictures, {still, moving, canvas} of opaque ones.
    constructor(canvas, soup, mesh, targets) {
        [this.canvas, this.soup, this.mesh, this.look, this.targets] = [canvas, soup, mesh, soup.look, targets];
        [this.amount, this.shown, this.drawn, this.enlarged] = [0, 0, 0, 1];
        [this.found, this.wanted, this.asked] = ["", "", null];
    }

    // The highest degree of the harmonics that is drawn.
    static degreeOf(soup) {
        return Math.min(Math.round(Math.sqrt(soup.bases)) - 1, soup.look.sh_degree ?? 3);
    }

    // `shown` triangles are in order, of the first `amount`.
    ordered(amount, shown) {
        const { ends, enlarged } = this.soup;
        [this.amount, this.shown, this.enlarged] = [amount, shown, enlarged[ends.indexOf(amount)] ?? 1];
    }

    // The next `share` of the triangles of the soft picture, which is begun anew where it is `fresh`. Where what is drawn of it
    // is not opaque yet, the picture of the camera in motion is seen through it. Returns whether that was all: then it
    // is the picture of `draw`, to the bit.
    refine(camera, share, fresh) {
        const { canvas, shown, targets: { whole, small } } = this;
        if (fresh) {
            whole.begin(canvas.width, canvas.height);
            this.drawn = 0;
        } else {
            whole.resume();
        }
        const end = Math.min(shown, this.drawn + Math.ceil(share * shown));
        this.drawSoft(camera, whole, this.drawn, end);
        this.drawn = end;
        this.show(whole.end(), 1, end < shown ? small.texture : null);
        return end === shown;
    }

    // A picture of `mode`, "soft" or "opaque", in the canvas. Where it is not `still`, it is drawn `scale` times as large,
    // 1 or less; where it is, an opaque one is drawn with many samples of a pixel.
    draw(camera, mode, { scale = 1, still = true } = {}) {
        const { targets, canvas: { width, height } } = this;
        if (mode === "soft" && still) { this.refine(camera, 1, true); return; }
        const samples = still ? STILL_SAMPLES : 1;
        const sides = [width, height].map((side) => Math.max(1, Math.round((still ? samples : scale) * side)));
        const target = mode === "soft" ? targets.small : still ? targets.still : scale < 1 ? targets.moving : targets.canvas;
        target.begin(...sides);
        if (mode === "soft") this.drawSoft(camera, target, 0, this.shown);
        else this.drawOpaque(camera, target);
        const drawn = target.end();
        if (drawn) this.show(drawn, samples);
    }
}
