// A small WebGL 2 viewer for one triangle mesh: orbit, pan, zoom; face colours or shaded shape; wireframe.
// Every triangle is expanded to three corners, so that colours are per face and `gl_VertexID % 3` names the corner.
"use strict";

const VERTEX_SHADER = `#version 300 es
${CAMERA_UNIFORMS}
in vec3 position;
in vec3 faceNormal;
in vec3 faceColor;
flat out vec3 normal;
flat out vec3 color;
out vec3 corner;
void main() {
    int k = gl_VertexID % 3;
    corner = vec3(k == 0, k == 1, k == 2);
    normal = vec3(1.0, -1.0, -1.0) * (faceNormal * turn);  // y up, z towards the eye: light comes from above
    color = faceColor;
    gl_Position = clipped(seen(position));
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

function upload(gl, program, name, array, type, normalized) {
    const location = gl.getAttribLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, array, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, 3, type, normalized, 0, 0);
}

// Stands before the mesh, a little above and beside it, with +y up.
function cameraFor({ center, radius }) {
    const [yaw, pitch] = [0.6, 0.25];
    const back = [Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch), Math.cos(yaw) * Math.cos(pitch)];
    // The picture is one high and wide, and 1.1 focal lengths of it are 2.5 radii away.
    const lens = [1.1, 1.1, 0.5, 0.5, 1, 1];
    return new Camera({ eye: along(center, back, 2.5 * radius), target: center, up: [0, 1, 0], lens }, radius);
}

// Shows `data` in `canvas`; returns {set(name, on)} for the options "shaded" and "wireframe".
function showMesh(canvas, data) {
    const gl = context(canvas, { antialias: true, alpha: true });
    const mesh = decodeMesh(data);
    const corners = expandCorners(mesh);
    const { program, at } = compileProgram(gl, VERTEX_SHADER, FRAGMENT_SHADER);
    gl.useProgram(program);
    upload(gl, program, "position", corners.positions, gl.FLOAT, false);
    upload(gl, program, "faceNormal", corners.normals, gl.BYTE, true);
    upload(gl, program, "faceColor", corners.colors, gl.UNSIGNED_BYTE, true);
    gl.enable(gl.DEPTH_TEST);
    const bounds = boundsOf(mesh.vertices);
    const camera = cameraFor(bounds);
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
        const near = Math.max(camera.distance - 2 * bounds.radius, 0.01 * camera.distance);
        setCamera(gl, at, camera, camera.lensFor(width, height), [width, height], near);
        gl.uniform1i(at.shaded, options.shaded);
        gl.uniform1i(at.wireframe, options.wireframe);
        gl.uniform3f(at.inkColor, 0.05, 0.16, 0.32);
        gl.drawArrays(gl.TRIANGLES, 0, corners.count);
    }

    function draw() {
        if (!pending) requestAnimationFrame(render);
        pending = true;
    }

    listenToMotion(canvas, camera, draw);
    new ResizeObserver(draw).observe(canvas);
    draw();
    return { set(name, on) { options[name] = on; draw(); } };
}
