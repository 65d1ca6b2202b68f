// The map of designs on the live page: photons that a sensor needs, over the diameter and the phase shifts.
// A click or the arrow keys choose a design of the map for the sensor above.
"use strict";

(() => {
  const { designs, colors, page } = window.zwfsLive;
  const { diameters, shifts, costs, contours, most } = designs;
  const find = (name) => document.getElementById(`live-${name}`);
  const map = find("designs");
  const choices = [...document.querySelectorAll("input[name=live-cost]")];

  const stepOf = (values) => (values.at(-1) - values[0]) / (values.length - 1);
  const nearest = (values, value) => Math.round((value - values[0]) / stepOf(values));
  const within = (values, place) => Math.min(values.length - 1, Math.max(0, place));
  const wavefronts = () => choices.find((choice) => choice.checked).value;
  const cost = () => costs[wavefronts()];

  // Position in the drawing, in cells, of a diameter and a shift.
  const across = (diameter) => (diameter - diameters[0]) / stepOf(diameters) + 0.5;
  const down = (shift) => shifts.length - 0.5 - (shift - shifts[0]) / stepOf(shifts);

  function paint() {
    const canvas = find("cost");
    const context = canvas.getContext("2d");
    const image = context.createImageData(diameters.length, shifts.length);
    cost().forEach((row, x) =>
      row.forEach((value, y) => {
        const level = Math.floor((256 * Math.log(value)) / Math.log(most));
        const from = 4 * Math.min(255, Math.max(0, level));
        const to = 4 * ((shifts.length - 1 - y) * diameters.length + x);
        image.data.set(colors.cost.subarray(from, from + 4), to);
      }),
    );
    context.putImageData(image, 0, 0);
    drawContours(contours[wavefronts()]);
    markBest();
  }

  function drawContours({ paths, labels }) {
    const lines = Object.entries(paths).map(([color, path]) => {
      const line = document.createElementNS("http://www.w3.org/2000/svg", "path");
      line.setAttribute("d", path);
      line.style.stroke = color;
      return line;
    });
    const texts = labels.map(({ text, color, ground, place }) => {
      const label = document.createElement("span");
      label.textContent = text;
      label.style.color = color;
      label.style.background = ground;
      put(label, ...place);
      return label;
    });
    find("contours").replaceChildren(...lines);
    find("costs").replaceChildren(...texts);
  }

  // Position on the map, in cells.
  function put(element, x, y) {
    element.style.left = `${(100 * x) / diameters.length}%`;
    element.style.top = `${(100 * y) / shifts.length}%`;
  }

  // The design of the map that needs the fewest photons.
  function markBest() {
    const least = Math.min(...cost().flat());
    const x = cost().findIndex((row) => row.includes(least));
    const shift = shifts[cost()[x].indexOf(least)];
    for (const element of map.querySelectorAll(".live-best")) mark(element, diameters[x], [shift, -shift]);
    find("best").textContent = `best up\nto ${diameters.at(-1)} λ/D`;
    put(find("best"), across(diameters[x]), down(shift));
  }

  // A bar from one shift to the other, or a point if they are of equal size.
  function mark(element, diameter, [a, b]) {
    const [x, high, low] = [across(diameter), down(Math.abs(a)), down(Math.abs(b))];
    element.setAttribute("d", `M${x} ${high}V${low}`);
  }

  // Places around a value with their weights, for a cubic interpolation; undefined outside the map.
  function around(values, value) {
    const place = (value - values[0]) / stepOf(values);
    if (place < -1e-6 || place > values.length - 1 + 1e-6) return undefined;
    const first = Math.min(Math.max(Math.floor(place) - 1, 0), values.length - 4);
    const four = [0, 1, 2, 3];
    const weight = (i) => four.reduce((w, j) => (j === i ? w : (w * (place - first - j)) / (i - j)), 1);
    return four.map((i) => [first + i, weight(i)]);
  }

  // Photons of a design with shifts of equal size, from the logarithms of the map.
  function photons(diameter, [a, b]) {
    const [xs, ys] = [around(diameters, diameter), around(shifts, Math.abs(a))];
    if (!xs || !ys || Math.abs(a + b) > 1e-6) return undefined;
    const terms = xs.flatMap(([x, u]) => ys.map(([y, v]) => u * v * Math.log(cost()[x][y])));
    return Math.exp(terms.reduce((sum, term) => sum + term));
  }

  function words(diameter, pair) {
    const [a, b] = pair.map((shift) => `${shift.toFixed(2)}π`.replace("-", "−"));
    const known = photons(diameter, pair);
    const other = Math.abs(a + b) > 1e-6 ? "the map has shifts of equal size only" : "not on this map";
    const answer = known ? `${known.toPrecision(3)} times the photons of an ideal sensor (${wavefronts()})` : other;
    return `${diameter.toFixed(2)} λ/D, ${a} and ${b}: ${answer}`;
  }

  let current = [diameters[0], [shifts[0], -shifts[0]]];
  function follow({ diameter, shifts: radian }) {
    current = [diameter, radian.map((shift) => shift / Math.PI)];
    for (const element of map.querySelectorAll(".live-own")) mark(element, ...current);
    find("design").textContent = words(...current);
    map.setAttribute("aria-label", `Map of designs. Chosen: ${words(...current)}. Arrow keys choose another one.`);
  }

  // The sensor follows at the next frame of the screen; the next key may come before.
  function choose(x, y) {
    const [diameter, shift] = [diameters[within(diameters, x)], shifts[within(shifts, y)]];
    current = [diameter, [shift, -shift]];
    const changes = { diameter: diameter.toFixed(2), "shift-a": shift.toFixed(2), "shift-b": (-shift).toFixed(2) };
    page.set(diameter > 2.2 ? { ...changes, likelihood: "1" } : changes); // beyond, the iteration diverges
  }

  map.addEventListener("click", (event) => {
    const box = find("cost").getBoundingClientRect();
    const x = Math.floor(((event.clientX - box.left) / box.width) * diameters.length);
    const y = Math.floor(((box.bottom - event.clientY) / box.height) * shifts.length);
    choose(x, y);
  });
  map.addEventListener("keydown", (event) => {
    const move = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!move) return;
    event.preventDefault();
    const [diameter, [a]] = current;
    choose(nearest(diameters, diameter) + move[0], nearest(shifts, Math.abs(a)) + move[1]);
  });
  for (const choice of choices) {
    choice.addEventListener("change", () => {
      paint();
      follow(page.settings());
    });
  }
  for (const element of map.querySelectorAll("[data-design]")) {
    const [diameter, ...pair] = element.dataset.design.split(" ").map(Number);
    mark(element, diameter, pair);
  }
  page.listen(follow);
  paint();
  follow(page.settings());
})();
