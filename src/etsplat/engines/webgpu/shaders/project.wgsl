// An invocation per triangle: its record, its depth as a key, and how many tiles it touches.
// Defined by the host: KERNEL (0 single-sided, 1 bilateral, 2 elastic, 3 hard), SDF (which of the two distances).

@group(0) @binding(0) var<uniform> view: Pass;
@group(0) @binding(1) var<storage, read> corners: array<f32>;    // nine of each triangle
@group(0) @binding(2) var<storage, read> softness: array<f32>;   // opacity and sigma
@group(0) @binding(3) var<storage, read_write> records: array<Record>;
@group(0) @binding(4) var<storage, read_write> keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> order: array<u32>;
@group(0) @binding(6) var<storage, read_write> counts: array<u32>;

const LOG2_E = 1.44269504088896;
const LN_2 = 0.693147180559945;
const MIN_SIGMA = 1e-6;
const LARGEST_EXTENT = 1e6;
const LARGEST = 3.402823466e38;
const NOWHERE = 0x7fffffffu;  // the key of what is nowhere: it goes last

// Largest x with opacity G(x) >= support_alpha, where ratio is their quotient.
fn support(ratio: f32, sigma: f32) -> f32 {
    if (KERNEL == 0u) {
        return 1.0 - exp2(-log2(ratio) / sigma);
    }
    if (KERNEL == 1u) {
        return exp2(min(0.5 * sigma * log2(2.0 * LN_2 * log2(ratio)), 30.0));
    }
    if (KERNEL == 2u) {
        return exp2(min(0.5 * sigma * log2(max(LN_2 * log2(ratio) / sigma, 1e-30)), 30.0));
    }
    return 1.0;
}

// Largest visible x, or a negative number if nothing is visible.
fn visible_extent(opacity: f32, sigma: f32) -> f32 {
    let most = min(view.x_max, LARGEST_EXTENT);
    if (view.support_alpha <= 0.0) {
        return select(most, min(most, 1.0), KERNEL == 0u || KERNEL == 3u);
    }
    let ratio = opacity / view.support_alpha;
    if (ratio < 1.0) {
        return -1.0;
    }
    return min(most, support(clamp(ratio, 1.0 + 1e-6, 1e30), sigma) * (1.0 + 1e-4) + 1e-5);
}

fn coefficients(sigma: f32) -> vec2<f32> {
    if (KERNEL == 0u) {
        return vec2(sigma, 0.0);
    }
    if (KERNEL == 1u) {
        return vec2(2.0 / sigma, -0.5 * LOG2_E);
    }
    if (KERNEL == 2u) {
        return vec2(2.0 / sigma, -sigma * LOG2_E);
    }
    return vec2(0.0);
}

struct Triangle {
    x: vec3<f32>, y: vec3<f32>, z: vec3<f32>,  // on the screen, in pixels; depth
    gx: vec3<f32>, gy: vec3<f32>,              // g_k = -w_k grad a_k
    weights: vec3<f32>,                        // w_k
    inradius: f32,
    valid: bool,
}

fn corner(i: u32, k: u32) -> vec3<f32> {
    return vec3(corners[9u * i + 3u * k], corners[9u * i + 3u * k + 1u], corners[9u * i + 3u * k + 2u]);
}

fn finite(a: vec3<f32>) -> bool {
    return below(a.x, LARGEST) && below(a.y, LARGEST) && below(a.z, LARGEST);
}

fn projected(i: u32) -> Triangle {
    var t = Triangle();
    t.valid = true;
    for (var k = 0u; k < 3u; k++) {
        let world = corner(i, k);
        t.valid = t.valid && finite(world);
        let at = vec4(world, 1.0);
        let seen = vec3(dot(view.rows[0], at), dot(view.rows[1], at), dot(view.rows[2], at));
        t.x[k] = (view.fx * seen.x + view.skew * seen.y) / seen.z + view.cx;
        t.y[k] = view.fy * seen.y / seen.z + view.cy;
        t.z[k] = seen.z;
        t.valid = t.valid && seen.z > view.near_plane && below(seen.z, 1e30) && below(t.x[k], 1e15) && below(t.y[k], 1e15);
    }
    return t;
}

// The linear forms of the distance from the projected corners; false without area on the screen.
fn set_up(t: ptr<function, Triangle>) -> bool {
    let ex = (*t).x.zxy - (*t).x.yzx;  // the side opposite to corner k
    let ey = (*t).y.zxy - (*t).y.yzx;
    let squared = ex * ex + ey * ey;
    let longest = max(squared.x, max(squared.y, squared.z));
    let area = ex.y * ey.z - ex.z * ey.y;
    let sides = sqrt(squared);
    let perimeter = sides.x + sides.y + sides.z;
    (*t).weights = select(vec3(3.0), perimeter / sides, SDF);
    let scale = (*t).weights / area;
    (*t).gx = scale * ey;
    (*t).gy = -scale * ex;
    (*t).inradius = abs(area) / perimeter;
    return abs(area) > max(1e-6 * longest, 1e-12) && below(area, 1e30) && below(longest, 1e30);
}

fn screen_size(t: Triangle) -> f32 {
    let x = t.x - vec3(t.x.x + t.x.y + t.x.z) / 3.0;
    let y = t.y - vec3(t.y.x + t.y.y + t.y.z) / 3.0;
    let squared = x * x + y * y;
    return sqrt(max(squared.x, max(squared.y, squared.z)));
}

fn record_of(t: Triangle, extent: f32, opacity: f32, kernel: vec2<f32>) -> Record {
    let share = 1.0 / t.weights;
    let q = vec2((t.x.y - t.x.x) * share.y + (t.x.z - t.x.x) * share.z + t.x.x,
                 (t.y.y - t.y.x) * share.y + (t.y.z - t.y.x) * share.z + t.y.x);
    let x = t.x - q.x;
    let y = t.y - q.y;
    let box = extent * vec4(min(x.x, min(x.y, x.z)), max(x.x, max(x.y, x.z)),
                            min(y.x, min(y.y, y.z)), max(y.x, max(y.y, y.z)));
    return Record(vec4(q, extent, opacity), vec4(t.gx, kernel.x), vec4(t.gy, kernel.y), box,
                  vec4(share, t.inradius), vec4(share / t.z, screen_size(t)));
}

fn meets_image(record: Record) -> bool {
    let q = record.place.xy;
    return q.x + record.box.y >= 0.0 && q.x + record.box.x <= f32(view.width) &&
           q.y + record.box.w >= 0.0 && q.y + record.box.z <= f32(view.height);
}

fn tiles_touched(record: Record) -> u32 {
    let search = tile_search(record, view.width, view.height);
    var count = 0u;
    for (var row = search.top; row < search.top + search.rows; row++) {
        for (var column = search.left; column < search.left + search.columns; column++) {
            count += select(0u, 1u, touches(record, search.slack, column, row));
        }
    }
    return count;
}

@compute @workgroup_size(256)
fn project(@builtin(local_invocation_index) t: u32, @builtin(workgroup_id) group: vec3<u32>,
           @builtin(num_workgroups) groups: vec3<u32>) {
    let i = linear(group, groups) * 256u + t;
    if (i >= view.triangles) {
        return;
    }
    let opacity = softness[2u * i];
    let given = softness[2u * i + 1u];
    let sigma = max(given, MIN_SIGMA);
    let extent = visible_extent(opacity, sigma);
    var triangle = projected(i);
    var visible = below(opacity, LARGEST) && opacity > 0.0 && below(given, LARGEST) && given > 0.0;
    visible = visible && triangle.valid && set_up(&triangle) && extent > 0.0;
    let depth = (triangle.z.x + triangle.z.y + triangle.z.z) / 3.0;
    var record = record_of(triangle, extent, opacity, coefficients(sigma));
    visible = visible && depth > 0.0 && meets_image(record);
    var count = 0u;
    if (visible) {
        count = tiles_touched(record);
    } else {
        record.product.w = -1.0;
    }
    records[i] = record;
    keys[i] = select(NOWHERE, bitcast<u32>(depth), count > 0u);
    order[i] = i;
    counts[i] = count;
}
