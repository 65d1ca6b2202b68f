// The phasors of one pixel on the page of the first chapter: a slider moves the phase, both images follow.
// The notebook puts an empty box with the computed reference waves on the page.
"use strict";

(() => {
  const box = document.getElementById("phasor");
  if (!box) return;
  const waves = JSON.parse(box.dataset.waves); // of both masks: real and imaginary part
  const SCALE = 50; // SVG units of an amplitude of 1
  const [WIDE, HIGH, TOP] = [500, 190, 3.2]; // of the curves; TOP is the largest intensity
  const IMAGES = ["1", "2"];
  const NEAR = 0.02; // rad; closer solutions are one

  const wrap = (angle) => angle - 2 * Math.PI * Math.round(angle / (2 * Math.PI));
  const round = (number) => number.toFixed(2);
  const signed = (angle) => `${angle < 0 ? "−" : "+"}${round(Math.abs(angle))}`;
  const tip = ([re, im], phase) => [re + Math.cos(phase), im + Math.sin(phase)];
  const intensity = (wave, phase) => tip(wave, phase).reduce((sum, part) => sum + part * part, 0);
  const mirrored = ([re, im], phase) => wrap(2 * Math.atan2(im, re) - phase);
  const at = ([re, im]) => `${round(SCALE * re)} ${round(-SCALE * im)}`;
  const place = (phase, level) => [((phase / Math.PI + 1) * WIDE) / 2, HIGH * (1 - level / TOP)].map(round);

  function arrow(from, to, kind) {
    const [x, y] = [to[0] - from[0], to[1] - from[1]];
    const size = 0.16 / Math.hypot(x, y);
    const wing = (side) => at([to[0] - size * (x - 0.5 * side * y), to[1] - size * (y + 0.5 * side * x)]);
    return `<path class="${kind}" d="M${at(from)}L${at(to)}"/><path d="M${wing(1)}L${at(to)}L${wing(-1)}"/>`;
  }

  const dot = ([x, y], kind) => `<circle class="${kind}" cx="${x}" cy="${y}" r="6"/>`;
  const dotAt = (point, kind) => dot(at(point).split(" "), kind);

  function plane(wave, phase, number) {
    const other = mirrored(wave, phase);
    const radius = SCALE * Math.sqrt(intensity(wave, phase));
    const [x, y] = at(wave).split(" ");
    return `<g class="phasor-faint"><circle class="phasor-dots" cx="${x}" cy="${y}" r="${SCALE}"/>
      ${arrow([0, 0], wave, "")}
      <path d="M-6 0H6M0 -6V6"/></g>
      <g class="phasor-${number}"><circle cx="0" cy="0" r="${round(radius)}"/>
      ${arrow(wave, tip(wave, other), "phasor-dashes")}${dotAt(tip(wave, other), "phasor-open")}
      <text x="-112" y="-104">image ${number}: ${round(intensity(wave, phase))}</text></g>
      ${arrow(wave, tip(wave, phase), "")}${dotAt(tip(wave, phase), "phasor-full")}`;
  }

  function curves(phase) {
    const steps = Array.from({ length: 121 }, (_, k) => Math.PI * (k / 60 - 1));
    const drawn = waves.map((wave, k) => {
      const level = intensity(wave, phase);
      const line = steps.map((angle) => place(angle, intensity(wave, angle)).join(" ")).join("L");
      const [, height] = place(0, level);
      return `<g class="phasor-${IMAGES[k]}"><path class="${k ? "phasor-dashes" : ""}" d="M${line}"/>
        <path class="phasor-faint phasor-dots" d="M0 ${height}H${WIDE}"/>
        ${dot(place(mirrored(wave, phase), level), "phasor-open")}</g>${dot(place(phase, level), "phasor-full")}`;
    });
    const ticks = [-3, -2, -1, 0, 1, 2, 3].map((angle) => {
      const text = String(angle).replace("-", "−");
      return `<text x="${place(angle, 0)[0]}" y="${HIGH + 20}" text-anchor="middle">${text}</text>`;
    });
    return `<path class="phasor-faint" d="M0 0V${HIGH}H${WIDE}"/>${ticks.join("")}${drawn.join("")}
      <text x="${WIDE / 2}" y="${HIGH + 40}" text-anchor="middle">phase of the pixel (rad)</text>
      <text x="6" y="4">intensity</text>`;
  }

  function sentences(phase) {
    const one = (k) => {
      const other = mirrored(waves[k], phase);
      const single = Math.abs(wrap(other - phase)) < NEAR;
      return `Image ${IMAGES[k]} allows ${single ? `${signed(phase)} rad only` : `${signed(phase)} and ${signed(other)} rad`}.`;
    };
    return `${one(0)} ${one(1)} Only ${signed(phase)} rad explains both.`;
  }

  box.innerHTML = `<label for="phasor-phase"><span>Phase of the pixel</span><output for="phasor-phase"></output></label>
    <input type="range" id="phasor-phase" min="-3.14" max="3.14" step="0.01" value="${box.dataset.phase}" autocomplete="off">
    <div class="phasor-planes">${IMAGES.map((number) => `<svg id="phasor-${number}" viewBox="-115 -120 215 215" role="img"></svg>`).join("")}</div>
    <p class="phasor-key">Grey arrow: reference wave. Cross: no light.</p>
    <svg id="phasor-curves" viewBox="-2 -24 504 259" role="img"></svg>
    <p class="phasor-says" role="status"></p>`;
  const slider = box.querySelector("input");

  function update() {
    const phase = Number(slider.value);
    const says = sentences(phase);
    IMAGES.forEach((number, k) => {
      const svg = box.querySelector(`#phasor-${number}`);
      svg.innerHTML = plane(waves[k], phase, number);
      svg.setAttribute("aria-label", `Waves of image ${number}, intensity ${round(intensity(waves[k], phase))}`);
    });
    const svg = box.querySelector("#phasor-curves");
    svg.innerHTML = curves(phase);
    svg.setAttribute("aria-label", `Intensities against phase. ${says}`);
    box.querySelector("output").textContent = `${signed(phase)} rad`;
    slider.setAttribute("aria-valuetext", `${signed(phase)} radian`);
    box.querySelector(".phasor-says").textContent = says;
  }

  slider.addEventListener("input", update);
  update();
  box.hidden = false;
})();
