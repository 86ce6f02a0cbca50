// For each triangle the key by which it is sorted, and its colour from where the camera stands (below view.wgsl).

@group(0) @binding(2) var<storage, read> harmonics: array<f32>;  // bases x RGB of a triangle
@group(0) @binding(3) var<storage, read_write> keys: array<u32>;
@group(0) @binding(4) var<storage, read_write> triangles: array<u32>;
@group(0) @binding(5) var<storage, read_write> paints: array<vec4<f32>>;

override DEGREE: u32;

// Real harmonics in the order and with the signs of csrc/math/spherical_harmonics.h.
fn basis_at(d: vec3<f32>) -> array<f32, 16> {
    var basis = array<f32, 16>();
    let square = d * d;
    basis[0] = 0.28209479177387814;
    if (DEGREE > 0u) {
        basis[1] = -0.4886025119029199 * d.y;
        basis[2] = 0.4886025119029199 * d.z;
        basis[3] = -0.4886025119029199 * d.x;
    }
    if (DEGREE > 1u) {
        basis[4] = 1.0925484305920792 * d.x * d.y;
        basis[5] = -1.0925484305920792 * d.y * d.z;
        basis[6] = 0.31539156525252005 * (2.0 * square.z - square.x - square.y);
        basis[7] = -1.0925484305920792 * d.x * d.z;
        basis[8] = 0.5462742152960396 * (square.x - square.y);
    }
    if (DEGREE > 2u) {
        basis[9] = -0.5900435899266435 * d.y * (3.0 * square.x - square.y);
        basis[10] = 2.890611442640554 * d.x * d.y * d.z;
        basis[11] = -0.4570457994644658 * d.y * (4.0 * square.z - square.x - square.y);
        basis[12] = 0.3731763325901154 * d.z * (2.0 * square.z - 3.0 * square.x - 3.0 * square.y);
        basis[13] = -0.4570457994644658 * d.x * (4.0 * square.z - square.x - square.y);
        basis[14] = 1.445305721320277 * d.z * (square.x - square.y);
        basis[15] = -0.5900435899266435 * d.x * (square.x - 3.0 * square.y);
    }
    return basis;
}

@compute @workgroup_size(256)
fn look(@builtin(global_invocation_id) id: vec3<u32>) {
    let triangle = id.x;
    if (triangle >= view.amount) {
        return;
    }
    let middle = (places[3u * triangle].xyz + places[3u * triangle + 1u].xyz + places[3u * triangle + 2u].xyz) / 3.0;
    let away = middle - view.eye;
    let depth = dot(view.forward, away);
    // Floats above 0 are in the order of their bits; what lies behind the camera goes to the end.
    keys[triangle] = select(0xffffffffu, bitcast<u32>(depth), depth > view.near);
    triangles[triangle] = triangle;
    var basis = basis_at(away / max(length(away), 1e-30));
    var color = vec3<f32>(0.5);
    for (var k = 0u; k < (DEGREE + 1u) * (DEGREE + 1u); k++) {
        let at = 3u * (view.bases * triangle + k);
        color += basis[k] * vec3<f32>(harmonics[at], harmonics[at + 1u], harmonics[at + 2u]);
    }
    paints[triangle] = vec4<f32>(max(color, vec3<f32>(0.0)), 1.0);
}
