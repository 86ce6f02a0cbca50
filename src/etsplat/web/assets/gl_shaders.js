// Triangles by their number alone: corners, opacity and softness are in a texture, and an element names a corner.
"use strict";

const TRIANGLES_A_ROW = 1024; // of a texture; a power of two

const TRIANGLE_DATA = `#version 300 es
precision highp float;
precision highp int;
uniform highp sampler2D places;  // three texels a triangle: corner and opacity, corner and softness, corner
uniform highp sampler2D colors;  // one or three texels
// Of a triangle, its column and row among the others; by shifts, since divisions take long in software.
ivec2 cell(int triangle) { return ivec2(triangle & ${TRIANGLES_A_ROW - 1}, triangle >> ${Math.log2(TRIANGLES_A_ROW)}); }
vec4 place(ivec2 cell, int corner) { return texelFetch(places, ivec2(3 * cell.x + corner, cell.y), 0); }
uniform float enlarged; // about the middle, where others are left out
const vec4 NOWHERE = vec4(2.0, 2.0, 2.0, 1.0);
${CAMERA_UNIFORMS}
vec3 larger(vec4 corner, vec3 middle) { return seen(corner.xyz + (enlarged - 1.0) * (corner.xyz - middle)); }`;

// A soft triangle is drawn as {x <= X}, itself made X times as large about its centre q, X the end of what is visible of it.
// The forms f_k, of which x is the largest, are affine on the image: X (1 - w_k) at corner k, X at the two others
// (docs/method.md, csrc/math/triangle.h). What is left out, and when, is in docs/conventions.md.
const SOFT_VERTEX = `${TRIANGLE_DATA}
uniform float cullLarge, cullSmall;
out vec3 forms;
flat out vec4 color;
flat out vec2 curve;
const float ALPHA_MIN = 1.0 / 255.0, X_MAX = 2.0;

float support(float ratio, float sigma) {
    float logs = log(max(ratio, 1.000001));
#if KERNEL == 0
    return 1.0 - exp(-logs / sigma);
#elif KERNEL == 1
    return pow(2.0 * logs, 0.5 * sigma);
#elif KERNEL == 2
    return exp2(min(0.5 * sigma * log2(max(logs / sigma, 1e-30)), 30.0));
#else
    return 1.0;
#endif
}

void main() {
    int triangle = gl_VertexID / 3, corner = gl_VertexID - 3 * triangle;
    ivec2 at = cell(triangle);
    vec4 a = place(at, 0), b = place(at, 1), c = place(at, 2);
    vec3 middle = (a.xyz + b.xyz + c.xyz) / 3.0;
    vec3 p0 = larger(a, middle), p1 = larger(b, middle), p2 = larger(c, middle);
    float opacity = a.w, sigma = max(b.w, 1e-6);
    gl_Position = NOWHERE;
    forms = vec3(0.0);
    color = vec4(texelFetch(colors, at, 0).rgb, opacity);
    curve = vec2(0.0);
    float ratio = opacity / ALPHA_MIN;
    if (min(p0.z, min(p1.z, p2.z)) <= near || ratio < 1.0) return;
    vec2 v0 = projected(p0), v1 = projected(p1), v2 = projected(p2);
    vec2 e0 = v2 - v1, e1 = v0 - v2, e2 = v1 - v0;
    vec3 sides = vec3(length(e0), length(e1), length(e2));
    float longest = max(sides.x, max(sides.y, sides.z)), perimeter = sides.x + sides.y + sides.z;
    float area = abs(e2.x * e1.y - e2.y * e1.x);
    if (area <= max(1e-6 * longest * longest, 1e-12)) return;
    vec2 mean = (v0 + v1 + v2) / 3.0;
    float reach = max(distance(v0, mean), max(distance(v1, mean), distance(v2, mean)));
    if (reach > cullLarge * max(size.x, size.y) || area < cullSmall * perimeter) return;
    float extent = min(X_MAX, support(ratio, sigma) * 1.0001 + 1e-5);
#if SDF
    vec3 weights = perimeter / sides;
#else
    vec3 weights = vec3(3.0);
#endif
    vec2 q = v0 + (v1 - v0) / weights.y + (v2 - v0) / weights.z;
    vec2 mine = corner == 0 ? v0 : corner == 1 ? v1 : v2;
    vec3 own = vec3(corner == 0, corner == 1, corner == 2);
    forms = extent * (1.0 - weights * own);
#if KERNEL == 0
    curve = vec2(sigma, 0.0);
#elif KERNEL == 1
    curve = vec2(2.0 / sigma, -0.72134752);
#else
    curve = vec2(2.0 / sigma, -1.44269504 * sigma);
#endif
    vec2 ndc = 2.0 * (q + extent * (mine - q)) / size - 1.0;
    gl_Position = vec4(ndc.x, -ndc.y, 0.0, 1.0);
}`;

// csrc/math/kernels.h: 0 single-sided, 1 bilateral, 2 elastic, 3 hard. Drawn nearest first, premultiplied. What is too faint
// to be drawn lies beyond the triangle's border: to ask for it here again would cost a tenth of the time in software.
const SOFT_FRAGMENT = `#version 300 es
precision highp float;
in vec3 forms;
flat in vec4 color;
flat in vec2 curve;
out vec4 pixel;
void main() {
    float x = max(forms.x, max(forms.y, forms.z));
#if KERNEL == 0
    float value = x < 1.0 ? exp2(curve.x * log2(max(1.0 - x, 1e-20))) : 0.0;
#elif KERNEL == 3
    float value = x <= 1.0 ? 1.0 : 0.0;
#else
    float value = exp2(curve.y * exp2(min(curve.x * log2(max(x, 1e-6)), 30.0)));
#endif
    float alpha = min(0.99, color.a * value);
    pixel = vec4(color.rgb * alpha, alpha);
}`;

// Opaque triangles for the depth buffer, with `perTriangle` colours (1 or 3); those with a corner before the near plane are
// left out whole, and of a soup those that are less than half opaque.
const OPAQUE_VERTEX = `${TRIANGLE_DATA}
uniform int perTriangle;
out vec3 color;
void main() {
    int triangle = gl_VertexID / 3, corner = gl_VertexID - 3 * triangle;
    ivec2 at = cell(triangle);
    vec4 a = place(at, 0), b = place(at, 1), c = place(at, 2);
    vec3 middle = (a.xyz + b.xyz + c.xyz) / 3.0;
    vec3 p0 = larger(a, middle), p1 = larger(b, middle), p2 = larger(c, middle);
    vec3 mine = corner == 0 ? p0 : corner == 1 ? p1 : p2;
    color = texelFetch(colors, perTriangle == 3 ? ivec2(3 * at.x + corner, at.y) : at, 0).rgb;
    bool shown = min(p0.z, min(p1.z, p2.z)) > near && a.w >= 0.5;
    gl_Position = shown ? clipped(mine) : NOWHERE;
}`;

const OPAQUE_FRAGMENT = `#version 300 es
precision highp float;
in vec3 color;
out vec4 pixel;
void main() { pixel = vec4(color, 1.0); }`;

// One triangle over everything: what was drawn at SAMPLES times the size, or at a smaller one, over the background; over
// another picture where it is UNFINISHED. Each kind is a program of its own, which takes two thirds of the time in software.
const RESOLVE_VERTEX = `#version 300 es
void main() {
    gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0);
}`;

const RESOLVE_FRAGMENT = `#version 300 es
precision highp float;
uniform highp sampler2D drawn, below;
uniform vec3 background;
uniform vec2 size;
out vec4 pixel;
void main() {
#if SAMPLES > 1
    vec4 sum = vec4(0.0);
    ivec2 first = SAMPLES * ivec2(gl_FragCoord.xy);
    for (int y = 0; y < SAMPLES; ++y)
        for (int x = 0; x < SAMPLES; ++x) sum += texelFetch(drawn, first + ivec2(x, y), 0);
    sum /= float(SAMPLES * SAMPLES);
#else
    vec4 sum = texture(drawn, gl_FragCoord.xy / size);
#endif
    vec3 behind = background;
#if UNFINISHED
    vec4 coarse = texture(below, gl_FragCoord.xy / size);
    behind = coarse.rgb + (1.0 - coarse.a) * background;
#endif
    pixel = vec4(sum.rgb + (1.0 - sum.a) * behind, 1.0);
}`;
