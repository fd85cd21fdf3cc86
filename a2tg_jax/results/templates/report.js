
// Draws every picture of a comparison over the one before it, as far as its slider says.
"use strict";
document.documentElement.classList.add("has-script");
for (const compare of document.querySelectorAll(".compare")) {
  const range = compare.querySelector("input");
  const stops = compare.querySelectorAll("button");
  const shown = compare.querySelector("output");
  const told = (value) => {
    const [left, right] = [Math.ceil(value), Math.floor(value)].map((at) => stops[at].textContent);
    return left === right ? `Shown: ${left}` : `Left: ${left}. Right: ${right}`;
  };
  const show = (value) => {
    range.value = value;
    compare.style.setProperty("--at", range.value);
    shown.textContent = told(Number(range.value));
    for (const stop of stops) stop.setAttribute("aria-pressed", String(stop.value === range.value));
  };
  // The pictures' column is as wide as a picture of the largest height.
  const picture = compare.querySelector("img");
  picture.decode().then(() => compare.style.setProperty("--ratio", picture.naturalWidth / picture.naturalHeight));
  range.addEventListener("input", () => show(range.value));
  for (const stop of stops) stop.addEventListener("click", () => show(stop.value));
  for (const layers of compare.querySelectorAll(".layers")) {
    layers.addEventListener("pointermove", (event) => {
      const box = layers.getBoundingClientRect();
      if (event.pointerType === "mouse") show(Number(range.max) - 1 + (event.clientX - box.left) / box.width);
    });
    layers.addEventListener("pointerleave", () => show(range.max));
  }
  show(range.max);
}
