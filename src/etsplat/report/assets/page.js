// The page's switches: how pictures are compared, what the viewer shows.
"use strict";

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

listenToComparisons();
listenToViewer();
