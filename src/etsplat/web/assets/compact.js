// Reads compact soups (.etz, described in docs/compact_format.md).
"use strict";

async function inflated(bytes) {
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Byte planes of `rows` numbers, one after the other, as they are asked for.
class Planes {
    constructor(bytes, rows) {
        [this.bytes, this.rows, this.first] = [bytes, rows, 0];
    }

    unsigned(size) {
        const values = new Int32Array(this.rows);
        for (let place = 0; place < size; ++place) {
            for (let i = 0; i < this.rows; ++i) values[i] |= this.bytes[this.first + i] << (8 * place);
            this.first += this.rows;
        }
        return values;
    }

    signed(size) {
        return this.unsigned(size).map((value) => (value >> 1) ^ -(value & 1));
    }
}

// Corners (9 floats a triangle) of a chunk.
function readCorners(planes, header, corners) {
    const { origin, step } = header.center;
    const centers = origin.map((first) => {
        const steps = planes.signed(3);
        let sum = 0;
        return Float64Array.from(steps, (value) => first + step * (sum = (sum + value) & 0xffffff));
    });
    const unitOf = Float64Array.from(planes.unsigned(1),
        (value) => header.size.least * 2 ** (value / header.size.per_octave) / header.offset.steps);
    const offsets = Array.from({ length: 6 }, () => planes.signed(2));
    for (let i = 0; i < planes.rows; ++i) {
        for (let k = 0; k < 3; ++k) {
            const [a, b] = [offsets[k][i] * unitOf[i], offsets[3 + k][i] * unitOf[i]];
            corners[9 * i + k] = centers[k][i] + a;
            corners[9 * i + 3 + k] = centers[k][i] + b;
            corners[9 * i + 6 + k] = centers[k][i] - a - b;
        }
    }
}

function readSoft(planes, header, soup, first) {
    const { rows } = planes;
    const into = (target, from, width, column, map) => {
        for (let i = 0; i < rows; ++i) target[width * (first + i) + column] = map(from[i]);
    };
    into(soup.opacities, planes.unsigned(1), 1, 0, (value) => value / 255);
    into(soup.sigma, planes.unsigned(1), 1, 0, (value) => Math.exp(header.sigma.low + header.sigma.step * value));
    for (let column = 0; column < 3 * header.bases; ++column) {
        const step = column < 3 ? header.constant.step : header.rest.step;
        into(soup.harmonics, planes.signed(2), 3 * header.bases, column, (value) => step * value);
    }
}

// {count, corners, opacities, sigma, harmonics, bases} of soft triangles, {count, corners, colors} of opaque ones, both with
// `look`, how they are drawn, `whole`, how many there are if nothing is cut off, `ends`, the lengths of the prefixes that draw,
// and `enlarged`, how much larger in each of them.
async function readCompact(buffer) {
    const view = new DataView(buffer);
    const [magic, version, length] = [0, 4, 8].map((at) => view.getUint32(at, true));
    if (magic !== 0x5a535445 || version !== 1) throw new Error("this is no compact soup of version 1");
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 12, length)));
    const { bases } = header;
    let [count, end] = [0, 12 + length];
    for (const [rows, size] of header.chunks) {
        end += size;
        if (end > buffer.byteLength) break; // cut short: what is there draws
        count += rows;
    }
    const { appearance: look, enlarged = [] } = header;
    const whole = header.chunks.reduce((sum, [rows]) => sum + rows, 0);
    const soup = { count, whole, bases, look, enlarged, corners: new Float32Array(9 * count), ends: [] };
    if (bases) {
        [soup.opacities, soup.sigma] = [new Float32Array(count), new Float32Array(count)];
        soup.harmonics = new Float32Array(3 * bases * count);
    } else {
        soup.colors = new Uint8Array(9 * count);
    }
    let [at, first] = [12 + length, 0];
    for (const [rows, size] of header.chunks) {
        if (first === count) break;
        const planes = new Planes(await inflated(new Uint8Array(buffer, at, size)), rows);
        readCorners(planes, header, soup.corners.subarray(9 * first));
        if (bases) {
            readSoft(planes, header, soup, first);
        } else {
            for (let column = 0; column < 9; ++column) {
                planes.unsigned(1).forEach((value, i) => { soup.colors[9 * (first + i) + column] = value; });
            }
        }
        [at, first] = [at + size, first + rows];
        soup.ends.push(first);
    }
    return soup;
}
