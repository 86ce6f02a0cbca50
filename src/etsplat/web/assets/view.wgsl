// What a picture is drawn with: a camera (rows of its turn: right, down, forward), and how the scene is looked at.
struct View {
    right: vec3<f32>, near: f32,
    down: vec3<f32>, enlarged: f32,
    forward: vec3<f32>, cull_large: f32,
    eye: vec3<f32>, cull_small: f32,
    lens: vec4<f32>,  // fx, fy, cx, cy in pixels of `size`
    size: vec2<f32>,
    amount: u32,      // of triangles, from the first on
    bases: u32,       // harmonics that each has
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> places: array<vec4<f32>>;  // of corners; their last numbers: opacity, softness, none

const NOWHERE = vec4<f32>(2.0, 2.0, 2.0, 1.0);

fn seen(world: vec3<f32>) -> vec3<f32> {
    return (world - view.eye) * mat3x3<f32>(view.right, view.down, view.forward);
}

// A corner of a triangle that is enlarged about its middle, where others are left out.
fn larger(corner: vec3<f32>, middle: vec3<f32>) -> vec3<f32> {
    return seen(corner + (view.enlarged - 1.0) * (corner - middle));
}

fn projected(point: vec3<f32>) -> vec2<f32> {
    return view.lens.xy * point.xy / point.z + view.lens.zw;
}
