// What every picture drawn here shares: bytes from base64, vectors, WebGL programs.
"use strict";

function bytesOf(base64) {
    const text = atob(base64);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; ++i) bytes[i] = text.charCodeAt(i);
    return bytes.buffer;
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const along = (point, direction, step) => point.map((value, k) => value + step * direction[k]);
const unit = (a) => { const length = Math.hypot(...a) || 1; return a.map((value) => value / length); };

// `vector` turned about the unit `axis`, counterclockwise seen from its tip.
function turned(vector, axis, angle) {
    const [c, s, side, share] = [Math.cos(angle), Math.sin(angle), cross(axis, vector), dot(axis, vector)];
    return vector.map((value, k) => c * value + s * side[k] + (1 - c) * share * axis[k]);
}

function context(canvas, options) {
    const gl = canvas.getContext("webgl2", options);
    if (!gl) throw new Error("this browser has no WebGL 2");
    return gl;
}

// A program of two sources, and where its uniforms are: {program, at: {name: location}}.
function compileProgram(gl, vertex, fragment) {
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
        const shader = gl.createShader(kind);
        gl.shaderSource(shader, source);
        gl.compileShader(shader);
        if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
        gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const at = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); ++i) {
        const { name } = gl.getActiveUniform(program, i);
        at[name] = gl.getUniformLocation(program, name);
    }
    return { program, at };
}

// Shaders get a camera as `turn` (rows: right, down, forward), `eye` and `lens` (fx, fy, cx, cy in pixels of `size`).
const CAMERA_UNIFORMS = `
uniform mat3 turn;
uniform vec3 eye;
uniform vec4 lens;
uniform vec2 size;
uniform float near;
vec3 seen(vec3 world) { return (world - eye) * turn; }
vec2 projected(vec3 point) { return lens.xy * point.xy / point.z + lens.zw; }
// Far is infinity; y points down in pictures, up here.
vec4 clipped(vec3 p) {
    vec2 ndc = 2.0 * (lens.xy * p.xy + lens.zw * p.z) / size - p.z;
    return vec4(ndc.x, -ndc.y, p.z - 2.0 * near, p.z);
}`;

function setCamera(gl, at, pose, lens, size, near) {
    gl.uniformMatrix3fv(at.turn, false, [...pose.right, ...pose.down, ...pose.forward]);
    gl.uniform3fv(at.eye, pose.eye);
    gl.uniform4fv(at.lens, lens);
    gl.uniform2fv(at.size, size);
    gl.uniform1f(at.near, near);
}
