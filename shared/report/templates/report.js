"use strict";
const data = JSON.parse(document.getElementById("data").textContent);

// Clip, re-render and error of the frame that the slider names.
const slider = document.getElementById("frame");
if (slider) {
  const show = () => {
    const frame = data.frames[+slider.value];
    for (const name of ["clip", "render", "error"]) document.getElementById(`frame-${name}`).src = frame[name];
    document.getElementById("frame-label").textContent = frame.label;
  };
  slider.addEventListener("input", show);
  show();
}

// Print shows what the screen folds away.
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((e) => { e.open = true; }));

// A map fills the screen on a click; a second click goes close.
const dialog = document.getElementById("zoom");
for (const button of document.querySelectorAll(".zoomable")) {
  button.addEventListener("click", () => {
    const image = dialog.querySelector("img");
    image.src = button.querySelector("img").src;
    image.alt = button.querySelector("img").alt;
    dialog.className = "fit";
    dialog.showModal();
  });
}
if (dialog) {
  dialog.querySelector("img").addEventListener("click", (e) => {
    const image = e.target, shown = Math.min(innerWidth / image.naturalWidth, innerHeight / image.naturalHeight);
    const x = (e.clientX - innerWidth / 2) / shown, y = (e.clientY - innerHeight / 2) / shown;  // from the centre
    dialog.className = dialog.className === "fit" ? "close-up" : "fit";
    const scale = image.clientWidth / image.naturalWidth;
    dialog.scrollTo((x + image.naturalWidth / 2) * scale - innerWidth / 2,
      (y + image.naturalHeight / 2) * scale - innerHeight / 2);
  });
  dialog.querySelector("button").addEventListener("click", () => dialog.close());
}

startViewer(document.getElementById("viewer"), data.viewer);
