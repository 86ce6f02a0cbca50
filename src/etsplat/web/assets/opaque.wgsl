// Opaque triangles for the depth buffer (below view.wgsl): of a mesh with colours at corners, or those of a soup that are at
// least half opaque. One with a corner before the near plane is left out whole.

@group(0) @binding(2) var<storage, read> corner_colors: array<u32>;  // RGBA8
@group(0) @binding(3) var<storage, read> paints: array<vec4<f32>>;

struct Opaque {
    @builtin(position) position: vec4<f32>,
    @location(0) color: vec3<f32>,
}

// Where a corner is; far is infinity.
fn clipped(index: u32) -> vec4<f32> {
    let first = 3u * (index / 3u);
    var corners = array<vec4<f32>, 3>(places[first], places[first + 1u], places[first + 2u]);
    let middle = (corners[0].xyz + corners[1].xyz + corners[2].xyz) / 3.0;
    var nearest = 1e30;
    for (var k = 0u; k < 3u; k++) {
        nearest = min(nearest, larger(corners[k].xyz, middle).z);
    }
    if (nearest <= view.near || corners[0].w < 0.5) {
        return NOWHERE;
    }
    let p = larger(places[index].xyz, middle);
    let ndc = 2.0 * (view.lens.xy * p.xy + view.lens.zw * p.z) / view.size - p.z;
    return vec4<f32>(ndc.x, -ndc.y, p.z - view.near, p.z);
}

@vertex
fn mesh_vertex(@builtin(vertex_index) index: u32) -> Opaque {
    return Opaque(clipped(index), unpack4x8unorm(corner_colors[index]).rgb);
}

@vertex
fn soup_vertex(@builtin(vertex_index) index: u32) -> Opaque {
    return Opaque(clipped(index), paints[index / 3u].rgb);
}

@fragment
fn opaque_fragment(opaque: Opaque) -> @location(0) vec4<f32> {
    return vec4<f32>(opaque.color, 1.0);
}
