// The viewer of a scene: its parts, its switches, and when it draws.
"use strict";

const STILL_AFTER = 250; // milliseconds after the last motion
const SLOW = 45, FAST = 24; // milliseconds of a frame: above and below, pictures of a moving camera get smaller and larger
const PART = 120, LEAST = 0.04; // milliseconds that a part of a soft picture may take, and how much of it that is at least
const COARSE = 0.5; // of its size along each side: the first soft picture of a camera that stands, if it was not larger in motion
const SMALLEST = 0.2, FIRST = { soft: 0.5, opaque: 1 }; // of their sizes, along each side
const EARLY = 1 << 22; // characters of base64, a multiple of four: as much of a scene is shown before the rest is read

class SceneViewer {
    constructor(root, scene, device, soup, mesh) {
        [this.root, this.scene, this.device] = [root, scene, device];
        this.canvas = root.querySelector("canvas");
        this.hold(soup, mesh);
        device.returned = () => this.restore();
        this.options = { mode: "soft", fraction: 1, resolution: 1 };
        [this.moved, this.pace, this.before, this.frame, this.share] = [0, { ...FIRST }, 0, 0, 0];
        const first = scene.cameras[scene.start];
        const up = scene.up || first.rows[1].map((value) => -value);
        const target = along(first.eye, first.rows[2], Math.max(dot(along(scene.focus, first.eye, -1), first.rows[2]), 0.05 * scene.radius));
        this.camera = new Camera({ eye: first.eye, target, down: first.rows[1], up, lens: first.lens }, scene.radius);
        this.photo = scene.start;
        this.stand(scene.start);
        listenToMotion(this.canvas, this.camera, () => this.change(), () => this.stand(this.photo));
        new ResizeObserver(() => this.change()).observe(this.canvas);
    }

    // Shows these triangles from now on.
    hold(soup, mesh) {
        this.painter?.free();
        [this.soup, this.mesh] = [soup, mesh];
        this.painter = this.device.painter(soup, mesh, () => this.wake());
    }

    // Goes to a photo's camera.
    stand(index) {
        this.photo = index;
        this.camera.stand(this.scene.cameras[index], this.scene.focus);
        this.change();
    }

    set(name, value) {
        this.options[name] = value;
        this.change();
    }

    change() {
        this.moved = performance.now();
        this.wake();
    }

    wake() {
        this.frame ||= requestAnimationFrame((now) => this.step(now));
    }

    get amount() {
        const { ends, count } = this.soup;
        const asked = this.options.fraction * count;
        return Math.min(count, ends.find((end) => end >= asked) ?? count);
    }

    // The order in which soft triangles are wanted.
    request({ eye, forward } = this.camera) {
        return { eye: [...eye], forward: [...forward], near: this.soup.look.near_plane, amount: this.amount };
    }

    resize() {
        const scale = Math.min(window.devicePixelRatio || 1, 2) * this.options.resolution;
        const sides = [this.canvas.clientWidth, this.canvas.clientHeight].map((side) => Math.max(1, Math.round(side * scale)));
        if (this.canvas.width !== sides[0] || this.canvas.height !== sides[1]) [this.canvas.width, this.canvas.height] = sides;
    }

    // The device has lost all that it held.
    restore() {
        this.hold(this.soup, this.mesh);
        this.change();
    }

    // One frame: small while the camera moves, as fast as the last ones were drawn; whole when it stands, a soft one first
    // coarse, then a part after the other.
    step(now) {
        this.frame = 0;
        if (this.device.lost) return; // `restore` goes on
        this.resize();
        const moving = performance.now() - this.moved < STILL_AFTER;
        const { pace, painter, options: { mode } } = this;
        const took = this.before ? now - this.before : 0;
        if (moving && took > SLOW) pace[mode] = Math.max(SMALLEST, pace[mode] * 0.9);
        if (moving && took && took < FAST) pace[mode] = Math.min(1, pace[mode] * 1.03);
        const ordered = (mode === "opaque" && this.mesh) || painter.order(this.request());
        const refining = mode === "soft" && !moving && ordered;
        if (!refining) {
            this.share = 0;
            painter.draw(this.camera, mode, { scale: pace[mode], still: !moving && mode === "opaque" });
        }
        const unfinished = refining && !this.refine();
        this.before = moving || unfinished ? now : 0;
        if (moving || unfinished) this.wake();
    }

    // A coarse picture in the order that has come, or the next part of the whole one; returns whether it is whole.
    refine() {
        const { painter, camera, pace: { soft } } = this;
        const first = !this.share;
        if (!first) { // frames come before the device is done with what was asked of it last
            if (!painter.done) return false;
            const took = performance.now() - this.begun;
            this.share = Math.min(1, Math.max(LEAST, this.share * Math.min(2, Math.max(0.5, PART / took))));
        }
        this.begun = performance.now();
        let whole = false;
        if (first && soft < 1) {
            const scale = Math.max(COARSE, soft);
            [this.share, this.fresh] = [scale * scale, true]; // it has so many of the whole one's pixels
            painter.draw(camera, "soft", { scale, still: false });
        } else {
            whole = painter.refine(camera, this.share || 1, this.fresh || first);
            this.fresh = false;
        }
        if (whole) this.share = 0;
        else painter.mark();
        return whole;
    }

    // For scripts: done when what is shown is not going to change by itself any more.
    async settled() {
        while (this.frame || this.painter.wanted) await new Promise((done) => setTimeout(done, 5));
    }

    // For scripts: the canvas with a photo's picture of so many pixels, when it is drawn; until the camera moves.
    async picture({ photo, mode, width, height }) {
        const camera = new Camera(this.camera.home, this.scene.radius);
        camera.stand(this.scene.cameras[photo], this.scene.focus);
        while (!this.painter.order(this.request(camera))) await this.painter.asked;
        this.share = 0;
        [this.canvas.width, this.canvas.height] = [width, height];
        this.painter.draw(camera, mode);
        return this.canvas;
    }
}

function fillList(root, viewer) {
    const list = root.querySelector("[data-list=photos]");
    viewer.scene.cameras.forEach(({ name }, index) => list.add(new Option(name, index)));
    list.value = viewer.photo;
    const go = (index) => {
        const count = viewer.scene.cameras.length;
        list.value = (index + count) % count;
        viewer.stand(Number(list.value));
    };
    list.addEventListener("change", () => go(Number(list.value)));
    for (const button of root.querySelectorAll("[data-step]")) {
        button.addEventListener("click", () => go(viewer.photo + Number(button.dataset.step)));
    }
}

function listenToSwitches(root, viewer) {
    fillList(root, viewer);
    const apply = {
        mode: (value) => viewer.set("mode", value),
        motion: (value) => { viewer.camera.flying = value === "fly"; },
    };
    for (const group of root.querySelectorAll("[data-switch]")) {
        chooseOne(group, apply[group.dataset.switch]);
    }
    for (const name of ["fraction", "resolution"]) {
        const list = root.querySelector(`[data-list=${name}]`);
        list.addEventListener("change", () => viewer.set(name, Number(list.value)));
    }
    const help = root.querySelector("[data-help]"), button = root.querySelector("[data-open=help]");
    const show = (on) => { help.hidden = !on; button.setAttribute("aria-pressed", String(on)); };
    button.addEventListener("click", () => show(help.hidden));
    help.addEventListener("click", () => show(false));
    root.addEventListener("keydown", (event) => {
        if (event.key === "Escape") show(false);
        if (event.key === "?") show(help.hidden);
    });
}

// WebGPU where it is of hardware and has room for the scene, WebGL 2 elsewhere; ?draw=webgl or ?draw=webgpu in the address asks
// for one of them, also in software.
async function openDevice(canvas, soup) {
    const asked = new URLSearchParams(location.search).get("draw");
    if (asked === "webgl") return new GlDevice(canvas);
    const device = await GpuDevice.open(canvas, soup, asked === "webgpu").catch((error) => console.warn(error));
    if (!device && asked === "webgpu") throw new Error("this browser has no WebGPU that can show it");
    return device || new GlDevice(canvas);
}

// Shows the scene that the page holds, if it holds one; returns its viewer.
async function showScene() {
    const root = document.getElementById("scene");
    if (!root) return null;
    try {
        const part = (name) => document.getElementById(`scene-${name}`);
        const text = (name) => part(name)?.textContent ?? "";
        const read = (name, most) => (text(name) ? readCompact(bytesOf(text(name).slice(0, most))) : null);
        const scene = JSON.parse(part("data").textContent);
        const some = text("soup").length > EARLY ? EARLY : undefined;
        const [soup, mesh] = [await read("soup", some), await read("mesh", some)];
        const viewer = new SceneViewer(root, scene, await openDevice(root.querySelector("canvas"), soup), soup, mesh);
        root.querySelector("[data-device]").textContent = viewer.device.name;
        listenToSwitches(root, viewer);
        if (some) {
            root.dataset.early = viewer.soup.count;
            viewer.hold(await read("soup"), await read("mesh"));
            viewer.change();
        }
        root.dataset.ready = "true";
        return viewer;
    } catch (error) {
        const note = document.createElement("p");
        note.className = "note";
        note.textContent = `The scene cannot be shown here: ${error.message}. A recent browser with WebGL 2 shows it.`;
        root.replaceChildren(note);
        return null;
    }
}

const sceneViewer = showScene();
