// The page of the live sensor (live.md): sliders in, maps and numbers out. live-model.js computes what is shown.
"use strict";

(() => {
  const { compute, colors, inside, shape, sizes } = window.zwfsLive;
  const PHASE_LIMITS = [0.2, 0.5, 1, 2, Math.PI];
  const ERROR_LIMITS = [-6, -5, -4, -3, -2, -1, 0].flatMap((n) => [1, 2, 5].map((digit) => digit * 10 ** n));
  const INTENSITY_LIMITS = [1, 1.5, 2, 3, 4, 6, 8, 12, 16];
  const BRIGHT = 0.995; // part of the pixels that the colours of the images tell apart
  const SMALLEST = 1e-6; // errors below it are rounding and differ from machine to machine
  const PAUSE = 800; // ms without a change before the numbers are read out

  const find = (name) => document.getElementById(`live-${name}`);
  const sliders = [...document.querySelectorAll("#live input")];
  const value = (name) => Number(find(name).value);
  const signed = (number, digits) => `${number < 0 ? "−" : "+"}${Math.abs(number).toFixed(digits)}`;

  function power(number) {
    const exponent = String(Math.round(Math.log10(number)));
    return `10${[...exponent].map((digit) => "⁰¹²³⁴⁵⁶⁷⁸⁹"[digit] ?? "⁻").join("")}`;
  }

  function scientific(number, decimals = 1, times = " × ") {
    const [digits, exponent] = number.toExponential(decimals).split("e");
    return `${digits}${times}${power(10 ** Number(exponent))}`;
  }

  function error(number) {
    if (number < SMALLEST) return `< ${power(SMALLEST)}`;
    return number < 0.01 ? scientific(number) : number.toPrecision(3);
  }

  // What a slider says beside itself, and what a screen reader says.
  const photons = () => (value("photons") > 9 ? Infinity : 10 ** value("photons"));
  const captions = {
    rms: (v) => [`${v.toFixed(2)} rad`],
    seed: (v) => [`${v}`],
    diameter: (v) => [`${v.toFixed(2)} λ/D`, `${v.toFixed(2)} lambda over D`],
    "shift-a": (v) => [`${signed(v, 2)} π`, `${v.toFixed(2)} pi`],
    "shift-b": (v) => [`${signed(v, 2)} π`, `${v.toFixed(2)} pi`],
    photons: () => (photons() === Infinity ? ["no noise"] : [scientific(photons())]),
    iterations: (v) => [`${v}`],
  };

  function caption(slider) {
    const [seen, spoken] = captions[slider.id.replace("live-", "")](Number(slider.value));
    slider.parentElement.querySelector("output").textContent = seen;
    slider.setAttribute("aria-valuetext", spoken ?? seen);
  }

  const limitOf = (limits, size) => limits.find((limit) => limit >= size) ?? limits.at(-1);
  const named = (limit) => (limit === Math.PI ? "π" : limit < 0.01 ? scientific(limit, 0, "·") : String(limit));

  // Paint a map (row 0 at the bottom), transparent outside the pupil unless all of it is shown.
  function paint(name, map, palette, low, high, points = inside) {
    const canvas = find(name);
    const context = canvas.getContext("2d");
    const image = context.createImageData(canvas.width, canvas.height);
    const [rows, columns] = shape;
    for (const k of points) {
      const level = Math.floor(((map[k] - low) / (high - low)) * 256);
      const from = 4 * Math.min(255, Math.max(0, level));
      const to = 4 * ((rows - 1 - Math.floor(k / columns)) * columns + (k % columns));
      for (let channel = 0; channel < 4; channel++) image.data[to + channel] = palette[from + channel];
    }
    context.putImageData(image, 0, 0);
  }

  function panel(name, map, palette, ends, low, high, points) {
    const box = find(name).parentElement;
    box.classList.toggle("live-empty", !map);
    box.parentElement.querySelector(".live-ends").replaceChildren(
      ...ends.map((text) => Object.assign(document.createElement("span"), { textContent: text })),
    );
    paint(name, map ?? [], palette, low, high, map ? points : []);
  }

  const phasePanel = (name, map, limit, unit) =>
    panel(name, map, colors.phase, [`−${named(limit)}`, unit, `+${named(limit)}`], -limit, limit);

  const all = Array.from({ length: shape[0] * shape[1] }, (_, k) => k);
  const imagePanel = (name, map, limit) =>
    panel(name, map, colors.intensity, ["0", "", String(limit)], 0, limit, all);

  function curve(errors) {
    const places = (errors ?? []).map((size, i) => `${i},${1 - Math.log10(Math.max(size, SMALLEST))}`);
    document.querySelector(".live-line").setAttribute("points", places.join(" "));
    document.querySelector(".live-dot").setAttribute("d", places.length ? `M${places.at(-1)}h0` : "");
  }

  const wrapped = (angle) => angle - 2 * Math.PI * Math.round(angle / (2 * Math.PI));

  function describe(made, settings) {
    const shown = `${settings.rms.toFixed(2)} radian rms`;
    find("phase").setAttribute("aria-label", `Input phase, ${shown}`);
    for (const [k, letter] of ["a", "b"].entries()) {
      const largest = made.frames[k].reduce((a, b) => Math.max(a, b));
      find(`image-${letter}`).setAttribute("aria-label", `Image ${letter}, brightest ${largest.toFixed(2)}`);
    }
    const last = made.singular ? null : made.errors.at(-1);
    const outcome = made.singular ? "no reconstruction: singular" : `error ${error(last)} radian rms`;
    find("found").setAttribute("aria-label", `Phase found, ${outcome}`);
    find("error").setAttribute("aria-label", `Error of the phase found, ${outcome}`);
    find("curve").setAttribute("aria-label", `Error by iteration, ${outcome} after ${settings.iterations}`);
    find("announced").textContent = `Input ${shown}, ${outcome} after ${settings.iterations} iterations`;
  }

  let pause;
  function update() {
    const settings = {
      rms: value("rms"),
      seed: value("seed"),
      diameter: value("diameter"),
      shifts: [value("shift-a") * Math.PI, value("shift-b") * Math.PI],
      photons: photons(),
      iterations: value("iterations"),
    };
    const start = performance.now();
    const made = compute(settings);
    const time = performance.now() - start;

    const limit = limitOf(PHASE_LIMITS, 2.6 * settings.rms);
    phasePanel("phase", made.phase, limit, "rad");
    phasePanel("found", made.estimate?.map((angle) => wrapped(angle - made.piston)), limit, "rad");
    phasePanel("error", made.residual, limitOf(ERROR_LIMITS, 2.5 * (made.errors?.at(-1) ?? 0)), "");
    const sorted = Float64Array.from(made.frames.flatMap((frame) => [...frame])).sort();
    const top = limitOf(INTENSITY_LIMITS, sorted[Math.floor(BRIGHT * sorted.length)]);
    imagePanel("image-a", made.frames[0], top);
    imagePanel("image-b", made.frames[1], top);
    curve(made.errors);

    find("input-rms").textContent = `${settings.rms.toFixed(2)} rad rms`;
    find("strehl").textContent = made.strehl.toFixed(3);
    find("error-rms").textContent = made.singular ? "singular" : `${error(made.errors.at(-1))} rad`;
    find("unsolved").textContent = made.singular ? "all" : `${made.unsolved}`;
    find("time").textContent = `${time.toFixed(1)} ms`;
    find("says").textContent = made.singular
      ? "Singular: for these two shifts the determinant is 0 at every point. No reconstruction."
      : `Computing two images and ${settings.iterations} iterations at ${inside.length} points. The light ` +
        `through a dimple is made of ${sizes.rank} numbers, by ${sizes.functions} functions along each axis.`;
    clearTimeout(pause);
    pause = setTimeout(() => describe(made, settings), PAUSE);
  }

  // At most one update for each frame of the screen, however fast the slider moves.
  let asked = false;
  function ask() {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      update();
    });
  }

  for (const slider of sliders) {
    slider.addEventListener("input", () => {
      caption(slider);
      ask();
    });
    caption(slider);
  }

  let running;
  function run(on) {
    clearInterval(running);
    const next = () => set(find("seed"), (value("seed") % Number(find("seed").max)) + 1);
    running = on ? setInterval(next, 500) : null;
    find("run").textContent = on ? "Stop" : "Run seeds";
  }

  function set(slider, wanted) {
    slider.value = wanted;
    caption(slider);
    ask();
  }

  find("run").addEventListener("click", () => run(!running));
  find("reset").addEventListener("click", () => {
    run(false);
    for (const slider of sliders) set(slider, slider.defaultValue);
  });

  for (const bar of document.querySelectorAll("#live canvas.live-bar")) {
    const image = bar.getContext("2d").createImageData(256, 1);
    image.data.set(bar.parentElement.querySelector("[id^=live-image]") ? colors.intensity : colors.phase);
    bar.getContext("2d").putImageData(image, 0, 0);
  }
  update();
})();
