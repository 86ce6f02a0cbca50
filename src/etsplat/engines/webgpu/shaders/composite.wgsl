// Front-to-back compositing (paper, equation 1): a workgroup per tile, an invocation per pixel.
//
// Triangles come in batches, staged in workgroup memory with the sub-tiles of 8x4 pixels that each can touch.
// Defined by the host: KERNEL (as in project.wgsl), FLAT and CORNER (channels of each kind), STATISTICS (wanted or not).

@group(0) @binding(0) var<uniform> view: Pass;
@group(0) @binding(1) var<storage, read> records: array<Record>;
@group(0) @binding(2) var<storage, read> slot_triangle: array<u32>;
@group(0) @binding(3) var<storage, read> tile_ranges: array<vec2<u32>>;
@group(0) @binding(4) var<storage, read> flat_colors: array<f32>;
@group(0) @binding(5) var<storage, read> corner_colors: array<f32>;
@group(0) @binding(6) var<storage, read> background: array<f32>;
// Of each pixel its channels and alpha as bits of floats, then the index + 1 of the median triangle.
@group(0) @binding(7) var<storage, read_write> image: array<u32>;
@group(0) @binding(8) var<storage, read_write> max_weight: array<atomic<u32>>;

const CHANNELS = FLAT + CORNER;
const ROOM = max(CHANNELS, 1u);
const BATCH = 256u;
const SUB = vec2(8u, 4u);

struct Staged {
    place: vec4<f32>, gx: vec4<f32>, gy: vec4<f32>,  // as in Record
}

var<workgroup> staged: array<Staged, BATCH>;     // 12 KiB of the 16 that there are everywhere
var<workgroup> triangle_of: array<u32, BATCH>;
var<workgroup> todo: array<atomic<u32>, BATCH / 4u>;  // bit b of word 8 w + c: triangle 32 c + b may touch sub-tile w
var<workgroup> heaviest: array<atomic<u32>, BATCH>;
var<workgroup> alive: atomic<u32>;
var<workgroup> range_of: vec2<u32>;
var<workgroup> go_on: u32;

struct Pixel {
    transmittance: f32, alive: bool, median: u32,
    color: array<f32, ROOM>,
}

fn kernel_value(x: f32, exponent: f32, scale: f32) -> f32 {
    if (KERNEL == 0u) {
        return select(0.0, exp2(exponent * log2(max(1.0 - x, 1e-20))), x < 1.0);
    }
    if (KERNEL == 3u) {
        return select(0.0, 1.0, x <= 1.0);
    }
    return exp2(scale * exp2(min(exponent * log2(max(x, 1e-6)), 30.0)));
}

// Notes for triangle t of the batch which sub-tiles of the tile whose first pixel is `origin` it may touch. Conservative.
fn note_sub_tiles(t: u32, record: Record, origin: vec2<u32>) {
    let reach = 0.5 * vec2<f32>(SUB - 1u);
    let slack = vec3(record.place.z * (1.0 + 1e-5) + 1e-5) + reach.x * abs(record.gx.xyz) + reach.y * abs(record.gy.xyz);
    for (var w = 0u; w < 8u; w++) {
        let middle = vec2<f32>(origin + SUB * vec2(w % 2u, w / 2u)) + 0.5 + reach - record.place.xy;
        let in_box = middle.x >= record.box.x - reach.x && middle.x <= record.box.y + reach.x &&
                     middle.y >= record.box.z - reach.y && middle.y <= record.box.w + reach.y;
        if (in_box && all(record.gx.xyz * middle.x + record.gy.xyz * middle.y <= slack)) {
            atomicOr(&todo[8u * w + t / 32u], 1u << (t % 32u));
        }
    }
}

fn draw_corners(pixel: ptr<function, Pixel>, triangle: u32, forms: vec3<f32>, weight: f32) {
    let product = max(1.0 - forms, vec3(0.0)) * records[triangle].product.xyz;
    let shares = product / (product.x + product.y + product.z);
    for (var c = 0u; c < CORNER; c++) {
        let at = 3u * CORNER * triangle + c;
        let values = vec3(corner_colors[at], corner_colors[at + CORNER], corner_colors[at + 2u * CORNER]);
        (*pixel).color[FLAT + c] += weight * dot(shares, values);
    }
}

fn draw(pixel: ptr<function, Pixel>, k: u32, at: vec2<f32>) {
    let s = staged[k];
    let from_q = at - s.place.xy;
    let forms = s.gx.xyz * from_q.x + s.gy.xyz * from_q.y;
    let x = max(forms.x, max(forms.y, forms.z));
    if (!(x <= s.place.z)) {
        return;
    }
    let alpha = min(s.place.w * kernel_value(x, s.gx.w, s.gy.w), view.alpha_max);
    if (!(alpha >= view.alpha_min)) {
        return;
    }
    let rest = (*pixel).transmittance - alpha * (*pixel).transmittance;
    if (rest < view.transmittance_min) {
        (*pixel).alive = false;
        return;
    }
    let weight = alpha * (*pixel).transmittance;
    let triangle = triangle_of[k];
    for (var c = 0u; c < FLAT; c++) {
        (*pixel).color[c] += weight * flat_colors[FLAT * triangle + c];
    }
    if (CORNER > 0u) {
        draw_corners(pixel, triangle, forms, weight);
    }
    if ((*pixel).transmittance > 0.5 && rest <= 0.5) {
        (*pixel).median = triangle + 1u;
    }
    if (STATISTICS) {
        atomicMax(&heaviest[k], bitcast<u32>(weight));  // weights are not negative: their bits are ordered as they are
    }
    (*pixel).transmittance = rest;
}

fn stage(t: u32, slot: u32, origin: vec2<u32>) {
    let triangle = slot_triangle[slot];
    let record = records[triangle];
    staged[t] = Staged(record.place, record.gx, record.gy);
    triangle_of[t] = triangle;
    note_sub_tiles(t, record, origin);
    if (STATISTICS) {
        atomicStore(&heaviest[t], 0u);
    }
}

fn write_pixel(pixel: ptr<function, Pixel>, column: u32, row: u32) {
    let first = (row * view.width + column) * (CHANNELS + 2u);
    for (var c = 0u; c < CHANNELS; c++) {
        image[first + c] = bitcast<u32>((*pixel).color[c] + (*pixel).transmittance * background[c]);
    }
    image[first + CHANNELS] = bitcast<u32>(1.0 - (*pixel).transmittance);
    image[first + CHANNELS + 1u] = (*pixel).median;
}

// Whether a pixel of the tile goes on; the same in all invocations. Makes room for the next batch.
fn any_alive(t: u32, mine: bool) -> bool {
    workgroupBarrier();
    if (t == 0u) {
        atomicStore(&alive, 0u);
    }
    if (t < BATCH / 4u) {
        atomicStore(&todo[t], 0u);
    }
    workgroupBarrier();
    if (mine) {
        atomicOr(&alive, 1u);
    }
    workgroupBarrier();
    if (t == 0u) {
        go_on = atomicLoad(&alive);
    }
    return workgroupUniformLoad(&go_on) != 0u;
}

@compute @workgroup_size(256)
fn composite(@builtin(local_invocation_index) t: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let origin = TILE * group.xy;
    let sub_tile = t / 32u;
    let column = origin.x + SUB.x * (sub_tile % 2u) + t % SUB.x;
    let row = origin.y + SUB.y * (sub_tile / 2u) + t % 32u / SUB.x;
    let at = vec2(f32(column), f32(row)) + 0.5;
    let inside = column < view.width && row < view.height;
    if (t == 0u) {
        range_of = tile_ranges[group.y * view.tiles_x + group.x];
    }
    let range = workgroupUniformLoad(&range_of);
    var pixel = Pixel();
    pixel.transmittance = 1.0;
    pixel.alive = inside;
    for (var next = range.x; next < range.y; next += BATCH) {
        if (!any_alive(t, pixel.alive)) {
            break;
        }
        let count = min(range.y - next, BATCH);
        if (t < count) {
            stage(t, next + t, origin);
        }
        workgroupBarrier();
        for (var chunk = 0u; 32u * chunk < count && pixel.alive; chunk++) {
            var bits = atomicLoad(&todo[8u * sub_tile + chunk]);
            for (; bits != 0u && pixel.alive; bits &= bits - 1u) {
                draw(&pixel, 32u * chunk + firstTrailingBit(bits), at);
            }
        }
        if (STATISTICS) {
            workgroupBarrier();
            if (t < count) {
                atomicMax(&max_weight[triangle_of[t]], atomicLoad(&heaviest[t]));
            }
        }
    }
    if (inside) {
        write_pixel(&pixel, column, row);
    }
}
