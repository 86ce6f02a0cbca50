// One triangle over everything: what was drawn at `samples` times the size, or at a smaller one, over the background; over
// another picture where it is `unfinished`.

struct Resolve {
    background: vec3<f32>,
    samples: u32,
    size: vec2<f32>,
    unfinished: u32,
}

@group(0) @binding(0) var<uniform> resolve: Resolve;
@group(0) @binding(1) var drawn: texture_2d<f32>;
@group(0) @binding(2) var below: texture_2d<f32>;
@group(0) @binding(3) var linear_sampler: sampler;

@vertex
fn resolve_vertex(@builtin(vertex_index) index: u32) -> @builtin(position) vec4<f32> {
    return vec4<f32>(select(-1.0, 3.0, index == 1u), select(-1.0, 3.0, index == 2u), 0.0, 1.0);
}

@fragment
fn resolve_fragment(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
    var sum = vec4<f32>();
    if (resolve.samples > 1u) {
        let first = resolve.samples * vec2<u32>(at.xy);
        for (var y = 0u; y < resolve.samples; y++) {
            for (var x = 0u; x < resolve.samples; x++) {
                sum += textureLoad(drawn, first + vec2<u32>(x, y), 0);
            }
        }
        sum /= f32(resolve.samples * resolve.samples);
    } else {
        sum = textureSampleLevel(drawn, linear_sampler, at.xy / resolve.size, 0.0);
    }
    var behind = resolve.background;
    if (resolve.unfinished > 0u) {
        let coarse = textureSampleLevel(below, linear_sampler, at.xy / resolve.size, 0.0);
        behind = coarse.rgb + (1.0 - coarse.a) * resolve.background;
    }
    return vec4<f32>(sum.rgb + (1.0 - sum.a) * behind, 1.0);
}
