// One camera for every viewer: it stands somewhere, looks along `forward`, and turns about what it looks at or about itself.
"use strict";

const STEEPEST = 0.998; // of the cosine between forward and up

class Camera {
    // `home`: {eye, target, up, lens}; `radius` is how large what is looked at is, and the measure of steps.
    constructor(home, radius) {
        [this.home, this.radius] = [home, radius];
        [this.up, this.flying] = [unit(home.up), false];
        this.reset();
    }

    reset() {
        this.lens = this.home.lens;
        this.place(this.home);
    }

    // Stands at `eye` and looks at `target`; a photo's own axes come as `down`.
    place({ eye, target, down }) {
        this.eye = [...eye];
        this.forward = unit(along(target, eye, -1));
        const sag = down || this.up.map((value) => -value);
        this.right = unit(cross(sag, this.forward));
        this.down = cross(this.forward, this.right);
        this.distance = Math.max(Math.hypot(...along(target, eye, -1)), 1e-3 * this.radius);
    }

    // Of a photo: {rows: [right, down, forward], eye, lens}. `focus` is turned about, at its depth on the line of sight.
    stand(photo, focus) {
        [[this.right, this.down, this.forward], this.eye, this.lens] = [photo.rows.map((row) => [...row]), [...photo.eye], photo.lens];
        this.distance = Math.max(dot(along(focus, this.eye, -1), this.forward), 0.05 * this.radius);
    }

    get target() {
        return along(this.eye, this.forward, this.distance);
    }

    turn(dx, dy) {
        const { target, flying } = this;
        const rotate = (axis, angle) => {
            for (const name of ["right", "down", "forward"]) this[name] = turned(this[name], axis, angle);
        };
        const sign = flying ? 1 : -1;
        rotate(this.up, sign * dx);
        const before = [this.right, this.down, this.forward];
        rotate(this.right, sign * dy);
        // Not over the top, but back from there, where a photo looked.
        const steep = (forward) => Math.abs(dot(forward, this.up));
        if (steep(this.forward) > STEEPEST && steep(this.forward) > steep(before[2])) [this.right, this.down, this.forward] = before;
        this.right = unit(this.right);
        this.forward = unit(this.forward);
        this.down = cross(this.forward, this.right);
        if (!flying) this.eye = along(target, this.forward, -this.distance);
    }

    // Moves what is at the target along with the pointer; in heights of the picture.
    pan(dx, dy) {
        const step = this.distance * (this.lens[5] / this.lens[1]);
        this.eye = along(along(this.eye, this.right, -dx * step), this.down, -dy * step);
    }

    // Nearer by a factor; flying: a step ahead.
    scale(factor) {
        const { target } = this;
        if (this.flying) {
            this.eye = along(this.eye, this.forward, 0.5 * this.radius * Math.log(factor));
            return;
        }
        this.distance = Math.max(1e-3 * this.radius, Math.min(100 * this.radius, this.distance / factor));
        this.eye = along(target, this.forward, -this.distance);
    }

    // [right, down, forward] in units of `radius`.
    move(steps) {
        ["right", "down", "forward"].forEach((name, k) => { this.eye = along(this.eye, this[name], steps[k] * this.radius); });
    }

    // fx, fy, cx, cy for a canvas of so many pixels, in which the photo's frame is as large as it fits.
    lensFor(width, height) {
        const [fx, fy, cx, cy, w, h] = this.lens;
        const scale = Math.min(width / w, height / h);
        return [scale * fx, scale * fy, width / 2 + scale * (cx - w / 2), height / 2 + scale * (cy - h / 2)];
    }
}

const FLIGHT = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0] };
const FLIGHT_SPEED = 0.4; // radii a second

function pressedKeys(canvas, camera, changed) {
    const pressed = new Set();
    let last = 0;
    function fly(now) {
        if (!pressed.size) return;
        const step = FLIGHT_SPEED * Math.min(Math.max(now - last, 0) / 1000, 0.1); // a frame may have begun before the key
        last = now;
        for (const key of pressed) camera.move(FLIGHT[key].map((value) => value * step));
        changed();
        requestAnimationFrame(fly);
    }
    canvas.addEventListener("keydown", (event) => {
        const key = event.key.toLowerCase();
        if (!FLIGHT[key] || event.ctrlKey || event.metaKey || event.altKey) return;
        event.preventDefault();
        if (!pressed.size) {
            last = performance.now();
            requestAnimationFrame(fly);
        }
        pressed.add(key);
    });
    canvas.addEventListener("keyup", (event) => pressed.delete(event.key.toLowerCase()));
    canvas.addEventListener("blur", () => pressed.clear());
}

function listenToPointers(canvas, camera, changed) {
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
            camera.scale(span(event) / span(before));
            camera.pan(dx / 2, dy / 2);
        } else if (event.shiftKey || event.buttons & 6) {
            camera.pan(dx, dy);
        } else {
            const speed = camera.flying ? 1.5 : 4;
            camera.turn(speed * dx, speed * dy);
        }
        touches.set(event.pointerId, event);
        changed();
    });
    canvas.addEventListener("wheel", (event) => {
        event.preventDefault();
        camera.scale(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)));
        changed();
    }, { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
}

// Mouse, touch and keys move the camera; `changed` is called after each motion, `reset` to start over.
function listenToMotion(canvas, camera, changed, reset = () => camera.reset()) {
    listenToPointers(canvas, camera, changed);
    pressedKeys(canvas, camera, changed);
    canvas.addEventListener("dblclick", () => { reset(); changed(); });
    const actions = {
        ArrowLeft: () => camera.turn(-0.1, 0), ArrowRight: () => camera.turn(0.1, 0),
        ArrowUp: () => camera.turn(0, 0.1), ArrowDown: () => camera.turn(0, -0.1),
        "+": () => camera.scale(1.15), "=": () => camera.scale(1.15), "-": () => camera.scale(1 / 1.15), "0": reset,
    };
    canvas.addEventListener("keydown", (event) => {
        if (!actions[event.key]) return;
        event.preventDefault();
        actions[event.key]();
        changed();
    });
}
