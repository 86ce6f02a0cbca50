// Soft triangles, nearest first, premultiplied (below view.wgsl). The formulas are those of gl_shaders.js, which says more.

@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read> paints: array<vec4<f32>>;

override KERNEL: u32;  // 0 single-sided, 1 bilateral, 2 elastic, 3 hard
override SDF: bool;

const ALPHA_MIN = 1.0 / 255.0;
const X_MAX = 2.0;

struct Soft {
    @builtin(position) position: vec4<f32>,
    @location(0) forms: vec3<f32>,
    @location(1) @interpolate(flat) color: vec4<f32>,
    @location(2) @interpolate(flat) curve: vec2<f32>,
}

fn support(ratio: f32, sigma: f32) -> f32 {
    let logs = log(max(ratio, 1.000001));
    if (KERNEL == 0u) {
        return 1.0 - exp(-logs / sigma);
    }
    if (KERNEL == 1u) {
        return pow(2.0 * logs, 0.5 * sigma);
    }
    if (KERNEL == 2u) {
        return exp2(min(0.5 * sigma * log2(max(logs / sigma, 1e-30)), 30.0));
    }
    return 1.0;
}

fn curve_of(sigma: f32) -> vec2<f32> {
    if (KERNEL == 0u) {
        return vec2<f32>(sigma, 0.0);
    }
    return vec2<f32>(2.0 / sigma, select(-1.44269504 * sigma, -0.72134752, KERNEL == 1u));
}

@vertex
fn soft_vertex(@builtin(vertex_index) index: u32) -> Soft {
    let triangle = order[index / 3u];
    let corner = index % 3u;
    let a = places[3u * triangle];
    let b = places[3u * triangle + 1u];
    let c = places[3u * triangle + 2u];
    let opacity = a.w;
    let sigma = max(b.w, 1e-6);
    let nowhere = Soft(NOWHERE, vec3<f32>(), vec4<f32>(), vec2<f32>());
    let middle = (a.xyz + b.xyz + c.xyz) / 3.0;
    let p0 = larger(a.xyz, middle);
    let p1 = larger(b.xyz, middle);
    let p2 = larger(c.xyz, middle);
    let ratio = opacity / ALPHA_MIN;
    if (min(p0.z, min(p1.z, p2.z)) <= view.near || ratio < 1.0) {
        return nowhere;
    }
    let v0 = projected(p0);
    let v1 = projected(p1);
    let v2 = projected(p2);
    let e1 = v0 - v2;
    let e2 = v1 - v0;
    let sides = vec3<f32>(length(v2 - v1), length(e1), length(e2));
    let longest = max(sides.x, max(sides.y, sides.z));
    let perimeter = sides.x + sides.y + sides.z;
    let area = abs(e2.x * e1.y - e2.y * e1.x);
    if (area <= max(1e-6 * longest * longest, 1e-12)) {
        return nowhere;
    }
    let mean = (v0 + v1 + v2) / 3.0;
    let reach = max(distance(v0, mean), max(distance(v1, mean), distance(v2, mean)));
    if (reach > view.cull_large * max(view.size.x, view.size.y) || area < view.cull_small * perimeter) {
        return nowhere;
    }
    let extent = min(X_MAX, support(ratio, sigma) * 1.0001 + 1e-5);
    let weights = select(vec3<f32>(3.0), perimeter / sides, SDF);
    let q = v0 + (v1 - v0) / weights.y + (v2 - v0) / weights.z;
    let own = vec3<f32>(f32(corner == 0u), f32(corner == 1u), f32(corner == 2u));
    let mine = own.x * v0 + own.y * v1 + own.z * v2;
    let ndc = 2.0 * (q + extent * (mine - q)) / view.size - 1.0;
    let color = vec4<f32>(paints[triangle].rgb, opacity);
    return Soft(vec4<f32>(ndc.x, -ndc.y, 0.0, 1.0), extent * (1.0 - weights * own), color, curve_of(sigma));
}

@fragment
fn soft_fragment(soft: Soft) -> @location(0) vec4<f32> {
    let x = max(soft.forms.x, max(soft.forms.y, soft.forms.z));
    var value = 0.0;
    if (KERNEL == 0u) {
        value = select(0.0, exp2(soft.curve.x * log2(max(1.0 - x, 1e-20))), x < 1.0);
    } else if (KERNEL == 3u) {
        value = select(0.0, 1.0, x <= 1.0);
    } else {
        value = exp2(soft.curve.y * exp2(min(soft.curve.x * log2(max(x, 1e-6)), 30.0)));
    }
    let alpha = min(0.99, soft.color.a * value);
    return vec4<f32>(soft.color.rgb * alpha, alpha);
}
