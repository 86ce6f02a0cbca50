// What the shaders of the rasterizer share. One view is drawn at a time; formulas are those of csrc/math, which say more.
//
// Bits are looked at where a number may be Inf or NaN: WGSL lets an implementation assume that there are none.

struct Pass {
    rows: array<vec4<f32>, 3>,  // world to camera: rotation | translation
    fx: f32, skew: f32, cx: f32, fy: f32, cy: f32,
    near_plane: f32, support_alpha: f32, alpha_min: f32, alpha_max: f32, x_max: f32, transmittance_min: f32,
    triangles: u32, width: u32, height: u32, tiles_x: u32, tiles_y: u32, slots: u32,
    padding_0: u32, padding_1: u32, padding_2: u32,
}

// What a triangle is to the tiles: x(p) = max_k g_k . (p - q), drawn where x <= extent.
struct Record {
    place: vec4<f32>,    // q, extent, opacity
    gx: vec4<f32>,       // g_k by x, the kernel's exponent
    gy: vec4<f32>,       // g_k by y, the kernel's scale
    box: vec4<f32>,      // left, right, top, bottom of {x <= extent}, from q
    weights: vec4<f32>,  // 1 / w_k, inradius
    product: vec4<f32>,  // 1 / (w_k z_k), size on the screen, -1 of what is not visible
}

const TILE = 16u;

// |a| < limit; false for NaN.
fn below(a: f32, limit: f32) -> bool {
    return (bitcast<u32>(a) & 0x7fffffffu) < bitcast<u32>(limit);
}

// The number of an invocation: there are at most 65535 workgroups along an axis, so the host may spread them over two.
fn linear(group: vec3<u32>, groups: vec3<u32>) -> u32 {
    return group.y * groups.x + group.x;
}
