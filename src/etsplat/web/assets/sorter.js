// The order in which soft triangles are drawn, and their colours from where the camera stands: in a worker, since both take
// longer than a frame. The function is sent there as text, so it uses nothing from outside.
"use strict";

function makeSorter({ corners, harmonics, bases, degree }) {
    const count = corners.length / 9;
    const keys = new Uint32Array(count), other = new Uint32Array(count);
    const depths = new Float32Array(count), bits = new Uint32Array(depths.buffer);
    const buckets = new Uint32Array(65537), basis = new Float32Array(16);

    // Real harmonics of degree 0 to 3 at a unit direction, in the order and with the signs of csrc/math/spherical_harmonics.h.
    function fillBasis(x, y, z) {
        basis[0] = 0.28209479177387814;
        basis[1] = -0.4886025119029199 * y;
        basis[2] = 0.4886025119029199 * z;
        basis[3] = -0.4886025119029199 * x;
        if (degree < 2) return;
        const [xx, yy, zz] = [x * x, y * y, z * z];
        basis[4] = 1.0925484305920792 * x * y;
        basis[5] = -1.0925484305920792 * y * z;
        basis[6] = 0.31539156525252005 * (2 * zz - xx - yy);
        basis[7] = -1.0925484305920792 * x * z;
        basis[8] = 0.5462742152960396 * (xx - yy);
        if (degree < 3) return;
        basis[9] = -0.5900435899266435 * y * (3 * xx - yy);
        basis[10] = 2.890611442640554 * x * y * z;
        basis[11] = -0.4570457994644658 * y * (4 * zz - xx - yy);
        basis[12] = 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy);
        basis[13] = -0.4570457994644658 * x * (4 * zz - xx - yy);
        basis[14] = 1.445305721320277 * z * (xx - yy);
        basis[15] = -0.5900435899266435 * x * (xx - 3 * yy);
    }

    // RGB of the first `amount` triangles, four floats each: max(0, 1/2 + sum of basis times coefficient).
    function colorsFrom(eye, amount) {
        const colors = new Float32Array(4 * amount);
        const used = (degree + 1) * (degree + 1);
        for (let t = 0; t < amount; ++t) {
            const at = 9 * t;
            const d = [0, 1, 2].map((k) => (corners[at + k] + corners[at + 3 + k] + corners[at + 6 + k]) / 3 - eye[k]);
            const length = Math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) || 1;
            fillBasis(d[0] / length, d[1] / length, d[2] / length);
            for (let c = 0; c < 3; ++c) {
                let sum = 0.5;
                for (let k = 0; k < used; ++k) sum += basis[k] * harmonics[3 * (bases * t + k) + c];
                colors[4 * t + c] = sum > 0 ? sum : 0;
            }
        }
        return colors;
    }

    // One pass of a counting sort by 16 bits of the keys' depths; keeps the order of equal ones.
    function pass(from, to, amount, shift) {
        buckets.fill(0);
        for (let i = 0; i < amount; ++i) ++buckets[((bits[from[i]] >>> shift) & 65535) + 1];
        for (let b = 0; b < 65536; ++b) buckets[b + 1] += buckets[b];
        for (let i = 0; i < amount; ++i) to[buckets[(bits[from[i]] >>> shift) & 65535]++] = from[i];
    }

    // Triangles of the first `amount` whose middle is before the camera, nearest first, as three elements each. Floats above 0
    // are in the order of their bits, so two passes sort as the rasterizer does: by depth, then by index.
    function elementsFor(eye, forward, near, amount) {
        let shown = 0;
        for (let t = 0; t < amount; ++t) {
            let depth = 0;
            for (let k = 0; k < 3; ++k) {
                const at = 9 * t + k;
                depth += forward[k] * ((corners[at] + corners[at + 3] + corners[at + 6]) / 3 - eye[k]);
            }
            depths[t] = depth;
            if (depth > near) keys[shown++] = t;
        }
        pass(keys, other, shown, 0);
        pass(other, keys, shown, 16);
        const elements = new Uint32Array(3 * shown);
        for (let i = 0; i < shown; ++i) {
            const first = 3 * keys[i];
            elements[3 * i] = first;
            elements[3 * i + 1] = first + 1;
            elements[3 * i + 2] = first + 2;
        }
        return elements;
    }

    return ({ eye, forward, near, amount }) => ({
        elements: elementsFor(eye, forward, near, amount),
        colors: colorsFrom(eye, amount),
    });
}

// Answers {eye, forward, near, amount} with {elements, colors}, one after the other; where there are no workers, at once.
class Sorter {
    constructor(soup, degree) {
        const { corners, harmonics, bases } = soup;
        const data = { corners, harmonics, bases, degree };
        try {
            const text = `${makeSorter}
                let sort;
                onmessage = ({ data }) => {
                    if (data.corners) { sort = makeSorter(data); return; }
                    const sorted = sort(data);
                    postMessage(sorted, [sorted.elements.buffer, sorted.colors.buffer]);
                };`;
            this.worker = new Worker(URL.createObjectURL(new Blob([text], { type: "text/javascript" })));
            this.worker.postMessage(data);
        } catch {
            this.worker = null;
        }
        this.data = data;
        this.last = Promise.resolve();
    }

    // Answers no more.
    end() {
        this.worker?.terminate();
    }

    sort(request) {
        const here = () => (this.own ??= makeSorter(this.data))(request);
        const ask = () => new Promise((resolve) => {
            if (!this.worker) { resolve(here()); return; }
            this.worker.onmessage = ({ data }) => resolve(data);
            this.worker.onerror = () => { this.worker = null; resolve(here()); }; // a browser that forbids it says so late
            this.worker.postMessage(request);
        });
        this.last = this.last.then(ask);
        return this.last;
    }
}
