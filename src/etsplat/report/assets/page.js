// The page's switches: theme, how pictures are compared, what the viewer shows.
"use strict";

function chooseOne(group, apply) {
    const buttons = [...group.querySelectorAll("button")];
    for (const button of buttons) {
        button.addEventListener("click", () => {
            for (const other of buttons) other.setAttribute("aria-pressed", String(other === button));
            apply(button.value);
        });
    }
}

function listenToTheme() {
    const root = document.documentElement;
    document.getElementById("theme").addEventListener("click", () => {
        const dark = root.dataset.theme
            ? root.dataset.theme === "dark"
            : window.matchMedia("(prefers-color-scheme: dark)").matches;
        root.dataset.theme = dark ? "light" : "dark";
    });
}

function listenToComparisons() {
    const views = document.getElementById("views");
    if (!views) return;
    chooseOne(document.getElementById("compare-mode"), (mode) => { views.dataset.mode = mode; });
    chooseOne(document.getElementById("compare-with"), (shown) => {
        views.dataset.shown = shown;
        for (const image of views.querySelectorAll("img[data-render]")) image.src = image.dataset[shown];
    });
    for (const slider of views.querySelectorAll("input[type=range]")) {
        const frame = slider.closest(".compare");
        slider.addEventListener("input", () => frame.style.setProperty("--cut", `${slider.value}%`));
    }
}

function listenToViewer() {
    const canvas = document.getElementById("mesh");
    if (!canvas) return;
    try {
        const viewer = showMesh(canvas, JSON.parse(document.getElementById("mesh-data").textContent));
        chooseOne(document.getElementById("mesh-surface"), (surface) => viewer.set("shaded", surface === "shape"));
        const wireframe = document.getElementById("mesh-wireframe");
        wireframe.addEventListener("click", () => {
            const on = wireframe.getAttribute("aria-pressed") !== "true";
            wireframe.setAttribute("aria-pressed", String(on));
            viewer.set("wireframe", on);
        });
    } catch (error) {
        const note = document.createElement("p");
        note.className = "note";
        note.textContent = `The mesh cannot be shown here: ${error.message}. Open mesh.glb in a mesh viewer instead.`;
        canvas.replaceWith(note);
    }
}

listenToTheme();
listenToComparisons();
listenToViewer();
