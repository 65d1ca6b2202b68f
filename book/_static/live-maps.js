// The pictures of the live page: phases, errors, images, the focal plane and the curves. The scales of phases and
// errors are fixed, but for small inputs, which would be too faint.
"use strict";

(() => {
  const { size, places, inside, FOCAL, colors } = window.zwfsLive;
  const SMALL = 0.4; // radian rms: below it, the input sets the scales
  const ENDS = { phase: Math.PI, error: 1 }; // radian, of the scales
  const BRIGHT = 2.5; // of the scale of images
  const DECADES = 4; // of the focal plane
  const SMALLEST = 1e-6; // errors below it are rounding and differ from machine to machine

  const find = (name) => document.getElementById(`live-${name}`);
  const dark = () => document.documentElement.dataset.theme === "dark";
  const colorsOf = (name) => colors[name === "phase" && dark() ? "darkPhase" : name];
  const all = Int32Array.from(places, (_, k) => k);
  const upright = (place, width) => (width - 1 - Math.floor(place / width)) * width + (place % width);
  const pixels = places.map((place) => upright(place, size));
  const focalPixels = Int32Array.from({ length: FOCAL.size ** 2 }, (_, k) => upright(k, FOCAL.size));
  const focalPoints = Int32Array.from(focalPixels, (_, k) => k);

  function power(number) {
    const exponent = String(Math.round(Math.log10(number)));
    return `10${[...exponent].map((digit) => "⁰¹²³⁴⁵⁶⁷⁸⁹"[digit] ?? "⁻").join("")}`;
  }

  function scientific(number) {
    const [digits, exponent] = number.toExponential(0).split("e");
    return `${digits}×${power(10 ** Number(exponent))}`;
  }

  function error(number) {
    if (number < SMALLEST) return `< ${power(SMALLEST)}`;
    return number < 0.001 ? scientific(number) : number.toPrecision(2);
  }

  // Paint values on a canvas, transparent elsewhere; level turns a value into a share of the palette.
  const images = {};
  function paint(name, values, map, level, points = inside, where = pixels) {
    const canvas = find(name);
    canvas.parentElement.classList.toggle("live-empty", !values);
    const context = canvas.getContext("2d");
    const image = (images[name] ??= context.createImageData(canvas.width, canvas.height));
    const words = new Uint32Array(image.data.buffer);
    words.fill(0);
    const palette = new Uint32Array(colorsOf(map).buffer);
    const color = (value) => palette[Math.min(255, Math.max(0, level(value) * 256)) | 0];
    if (values) for (const k of points) words[where[k]] = color(values[k]);
    context.putImageData(image, 0, 0);
  }

  // The least of 1, 2 or 5 times a power of ten that is not below a number.
  function round(number) {
    const unit = 10 ** Math.floor(Math.log10(number));
    return unit * [1, 2, 5, 10].find((step) => step * unit >= 0.999 * number);
  }

  function scale(rms) {
    const small = rms > 0 && rms < SMALL;
    ENDS.phase = small ? Math.min(Math.PI, round(5 * rms)) : Math.PI;
    ENDS.error = small ? round(rms / 2) : 1;
    for (const bar of document.querySelectorAll(".live-scale[data-end]")) {
      const end = ENDS[bar.dataset.end];
      const text = end === Math.PI ? "π" : String(Number(end.toPrecision(1)));
      bar.firstElementChild.textContent = `−${text}`;
      bar.lastElementChild.textContent = `+${text}`;
    }
  }

  const phase = (name, map) => paint(name, map, "phase", (value) => (value / ENDS.phase + 1) / 2);
  const difference = (name, map) => paint(name, map, "phase", (value) => (value / ENDS.error + 1) / 2);
  const image = (name, map) => paint(name, map, "intensity", (value) => value / BRIGHT, all);

  function focal(name, light, diameter) {
    const level = (value) => 1 + Math.log10(value) / DECADES;
    paint(name, light, "intensity", level, focalPoints, focalPixels);
    for (const circle of document.querySelectorAll(".live-dimple circle")) circle.setAttribute("r", diameter / 2);
  }

  // A line for each method, on a logarithmic axis from 10 to 1e-6 radian; the linear method has no iterations.
  function curves(methods) {
    for (const [name, method] of Object.entries(methods)) {
      const errors = method ? method.errors : [];
      const ends = errors.length === 1 ? [errors[0], errors[0]] : errors;
      const step = errors.length === 1 ? Number(find("iterations").max) : 1;
      const points = ends.map((value, i) => `${i * step},${1 - Math.log10(Math.max(value, SMALLEST))}`);
      find(`line-${name}`).setAttribute("points", points.join(" "));
      document.querySelector(`.live-legend .live-${name}`).hidden = !method;
    }
  }

  function bars() {
    for (const bar of document.querySelectorAll("canvas.live-bar")) {
      const ramp = bar.getContext("2d").createImageData(256, 1);
      ramp.data.set(colorsOf(bar.dataset.colors));
      bar.getContext("2d").putImageData(ramp, 0, 0);
    }
  }

  window.zwfsLive.draw = { SMALLEST, error, scale, phase, difference, image, focal, curves, bars };
})();
