// A small WebGL 2 viewer for one triangle mesh: orbit, pan, zoom; face colours or shaded shape; wireframe.
// Every triangle is expanded to three corners, so that colours are per face and `gl_VertexID % 3` names the corner.
"use strict";

const VERTEX_SHADER = `#version 300 es
uniform mat4 clipFromModel;
uniform mat3 viewFromModel;
in vec3 position;
in vec3 faceNormal;
in vec3 faceColor;
flat out vec3 normal;
flat out vec3 color;
out vec3 corner;
void main() {
    int k = gl_VertexID % 3;
    corner = vec3(k == 0, k == 1, k == 2);
    normal = viewFromModel * faceNormal;
    color = faceColor;
    gl_Position = clipFromModel * vec4(position, 1.0);
}`;

const FRAGMENT_SHADER = `#version 300 es
precision highp float;
uniform bool shaded;
uniform bool wireframe;
uniform vec3 inkColor;
flat in vec3 normal;
flat in vec3 color;
in vec3 corner;
out vec4 pixel;
void main() {
    vec3 n = normalize(normal);
    vec3 clay = gl_FrontFacing ? vec3(0.80, 0.81, 0.83) : vec3(0.86, 0.50, 0.36);
    float light = 0.25 + 0.55 * abs(n.z) + 0.20 * max(dot(n, normalize(vec3(-0.5, 0.7, 0.5))), 0.0);
    vec3 surface = shaded ? clay * light : color;
    if (wireframe) {
        vec3 width = fwidth(corner);
        vec3 line = smoothstep(vec3(0.0), 1.1 * width, corner);
        // Where triangles are smaller than a few pixels the lines would fill them: fade out.
        float density = max(width.x, max(width.y, width.z));
        float ink = (1.0 - min(line.x, min(line.y, line.z))) * 0.6 * (1.0 - smoothstep(0.25, 0.9, density));
        surface = mix(surface, inkColor, ink);
    }
    pixel = vec4(surface, 1.0);
}`;

function bytesOf(base64) {
    const text = atob(base64);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; ++i) bytes[i] = text.charCodeAt(i);
    return bytes.buffer;
}

function decodeMesh(data) {
    return {
        vertices: new Float32Array(bytesOf(data.vertices)),
        faces: new Uint32Array(bytesOf(data.faces)),
        colors: new Uint8Array(bytesOf(data.colors)),
    };
}

function boundsOf(vertices) {
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    for (let i = 0; i < vertices.length; ++i) {
        low[i % 3] = Math.min(low[i % 3], vertices[i]);
        high[i % 3] = Math.max(high[i % 3], vertices[i]);
    }
    const center = low.map((value, k) => (value + high[k]) / 2);
    let radius = 0;
    for (let i = 0; i < vertices.length; i += 3) {
        radius = Math.max(radius, Math.hypot(...center.map((value, k) => vertices[i + k] - value)));
    }
    return { center, radius: radius || 1 };
}

// Corner arrays: positions (9 floats a face), normals (9 signed bytes), colours (9 bytes).
function expandCorners(mesh) {
    const count = mesh.faces.length;
    const positions = new Float32Array(3 * count);
    const normals = new Int8Array(3 * count);
    const colors = new Uint8Array(3 * count);
    for (let f = 0; f < count; f += 3) {
        const [a, b, c] = [0, 1, 2].map((k) => {
            const at = 3 * mesh.faces[f + k];
            const point = mesh.vertices.subarray(at, at + 3);
            positions.set(point, 3 * (f + k));
            colors.set(mesh.colors.subarray(f, f + 3), 3 * (f + k));
            return point;
        });
        const u = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
        const v = [c[0] - a[0], c[1] - a[1], c[2] - a[2]];
        const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        const scale = 127 / (Math.hypot(...n) || 1);
        for (let k = 0; k < 3; ++k) normals.set(n.map((value) => Math.round(value * scale)), 3 * (f + k));
    }
    return { count, positions, normals, colors };
}

function compileProgram(gl) {
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX_SHADER], [gl.FRAGMENT_SHADER, FRAGMENT_SHADER]]) {
        const shader = gl.createShader(kind);
        gl.shaderSource(shader, source);
        gl.compileShader(shader);
        if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
        gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
}

function upload(gl, program, name, array, type, normalized) {
    const location = gl.getAttribLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, array, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, 3, type, normalized, 0, 0);
}

// Turntable camera around `target`: yaw about +y, then pitch. Matrices are column-major.
class Orbit {
    constructor(bounds) {
        this.bounds = bounds;
        this.reset();
    }

    reset() {
        this.yaw = 0.6;
        this.pitch = 0.25;
        this.zoom = 1;
        this.target = [...this.bounds.center];
    }

    axes() {
        const [cy, sy, cp, sp] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)];
        return { right: [cy, 0, -sy], up: [-sy * sp, cp, -cy * sp], back: [sy * cp, sp, cy * cp] };
    }

    turn(dx, dy) {
        this.yaw -= dx;
        this.pitch = Math.max(-1.55, Math.min(1.55, this.pitch + dy));
    }

    pan(dx, dy) {
        const { right, up } = this.axes();
        const step = (2 * this.bounds.radius) / this.zoom;
        this.target = this.target.map((value, k) => value - step * (dx * right[k] - dy * up[k]));
    }

    scale(factor) {
        this.zoom = Math.max(0.3, Math.min(60, this.zoom * factor));
    }

    matrices(aspect) {
        const { right, up, back } = this.axes();
        const dot = (a) => a[0] * this.target[0] + a[1] * this.target[1] + a[2] * this.target[2];
        const focal = 2.2 * Math.min(1, aspect);
        const distance = (2.5 * this.bounds.radius) / this.zoom;
        const near = Math.max(distance - 2 * this.bounds.radius, 0.01 * distance);
        const far = distance + 4 * this.bounds.radius;
        const [a, b] = [(far + near) / (near - far), (2 * far * near) / (near - far)];
        const clip = [];
        for (let k = 0; k < 3; ++k) clip.push((focal / aspect) * right[k], focal * up[k], a * back[k], -back[k]);
        const depth = -dot(back) - distance;
        clip.push((-focal / aspect) * dot(right), -focal * dot(up), a * depth + b, -depth);
        const view = [0, 1, 2].flatMap((k) => [right[k], up[k], back[k]]);
        return { clip, view };
    }
}

function listen(canvas, orbit, draw) {
    const touches = new Map();
    canvas.addEventListener("pointerdown", (event) => {
        canvas.setPointerCapture(event.pointerId);
        touches.set(event.pointerId, event);
    });
    for (const name of ["pointerup", "pointercancel"]) {
        canvas.addEventListener(name, (event) => touches.delete(event.pointerId));
    }
    canvas.addEventListener("pointermove", (event) => {
        const before = touches.get(event.pointerId);
        if (!before) return;
        const size = canvas.clientHeight;
        const [dx, dy] = [(event.clientX - before.clientX) / size, (event.clientY - before.clientY) / size];
        if (touches.size === 2) {
            const other = [...touches.values()].find((touch) => touch.pointerId !== event.pointerId);
            const span = (touch) => Math.hypot(touch.clientX - other.clientX, touch.clientY - other.clientY) || 1;
            orbit.scale(span(event) / span(before));
            orbit.pan(dx / 2, dy / 2);
        } else if (event.shiftKey || event.buttons & 6) {
            orbit.pan(dx, dy);
        } else {
            orbit.turn(4 * dx, 4 * dy);
        }
        touches.set(event.pointerId, event);
        draw();
    });
    canvas.addEventListener("wheel", (event) => {
        event.preventDefault();
        orbit.scale(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)));
        draw();
    }, { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("dblclick", () => { orbit.reset(); draw(); });
    canvas.addEventListener("keydown", (event) => {
        const actions = {
            ArrowLeft: () => orbit.turn(-0.1, 0), ArrowRight: () => orbit.turn(0.1, 0),
            ArrowUp: () => orbit.turn(0, 0.1), ArrowDown: () => orbit.turn(0, -0.1),
            "+": () => orbit.scale(1.15), "=": () => orbit.scale(1.15), "-": () => orbit.scale(1 / 1.15), "0": () => orbit.reset(),
        };
        if (!actions[event.key]) return;
        event.preventDefault();
        actions[event.key]();
        draw();
    });
}

// Shows `data` in `canvas`; returns {set(name, on)} for the options "shaded" and "wireframe".
function showMesh(canvas, data) {
    const gl = canvas.getContext("webgl2", { antialias: true, alpha: true });
    if (!gl) throw new Error("this browser has no WebGL 2");
    const mesh = decodeMesh(data);
    const corners = expandCorners(mesh);
    const program = compileProgram(gl);
    gl.useProgram(program);
    upload(gl, program, "position", corners.positions, gl.FLOAT, false);
    upload(gl, program, "faceNormal", corners.normals, gl.BYTE, true);
    upload(gl, program, "faceColor", corners.colors, gl.UNSIGNED_BYTE, true);
    gl.enable(gl.DEPTH_TEST);
    const uniform = (name) => gl.getUniformLocation(program, name);
    const orbit = new Orbit(boundsOf(mesh.vertices));
    const options = { shaded: false, wireframe: false };
    let pending = false;

    function render() {
        pending = false;
        const scale = Math.min(window.devicePixelRatio || 1, 2);
        const [width, height] = [Math.round(canvas.clientWidth * scale), Math.round(canvas.clientHeight * scale)];
        if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
        gl.viewport(0, 0, width, height);
        gl.clearColor(0, 0, 0, 0);
        gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
        const { clip, view } = orbit.matrices(width / height);
        gl.uniformMatrix4fv(uniform("clipFromModel"), false, clip);
        gl.uniformMatrix3fv(uniform("viewFromModel"), false, view);
        gl.uniform1i(uniform("shaded"), options.shaded);
        gl.uniform1i(uniform("wireframe"), options.wireframe);
        gl.uniform3f(uniform("inkColor"), 0.05, 0.16, 0.32);
        gl.drawArrays(gl.TRIANGLES, 0, corners.count);
    }

    function draw() {
        if (!pending) requestAnimationFrame(render);
        pending = true;
    }

    listen(canvas, orbit, draw);
    new ResizeObserver(draw).observe(canvas);
    draw();
    return { set(name, on) { options[name] = on; draw(); } };
}
