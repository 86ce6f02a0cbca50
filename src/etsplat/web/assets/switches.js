// Groups of buttons of which one is chosen, and the theme.
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

listenToTheme();
