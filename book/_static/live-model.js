// The phase-shifted Zernike sensor and its iterative reconstruction, in the numbers that zwfs gave (live-data.js).
// No page is touched here: window.zwfsLive.compute(settings) takes numbers and returns numbers.
"use strict";

window.zwfsLive = (() => {
  const TYPES = { uint8: Uint8Array, float32: Float32Array, float64: Float64Array };
  const PARALLEL = 1e-6; // as in zwfs.PhaseShifted: sine below which two reference waves count as parallel,
  const DARK = 1e-9; // and amplitude below which one counts as absent
  const NORMAL = 30; // mean number of photons above which Poisson's distribution is taken to be normal

  const data = window.zwfsLiveData;

  function decode({ type, values }) {
    return new TYPES[type](Uint8Array.from(atob(values), (letter) => letter.charCodeAt(0)).buffer);
  }

  // Matrices are rows of doubles, one after the other.
  function matrix(encoded) {
    const [rows, columns] = encoded.shape;
    return { rows, columns, values: Float64Array.from(decode(encoded)) };
  }

  function transpose({ rows, columns, values }) {
    const place = (k) => (k % rows) * columns + Math.floor(k / rows);
    return { rows: columns, columns: rows, values: values.map((_, k) => values[place(k)]) };
  }

  function multiply({ rows, columns: inner, values: a }, { columns, values: b }) {
    const out = new Float64Array(rows * columns);
    for (let i = 0; i < rows; i++) {
      const to = i * columns;
      for (let k = 0; k < inner; k++) {
        const factor = a[i * inner + k];
        const from = k * columns;
        for (let j = 0; j < columns; j++) out[to + j] += factor * b[from + j];
      }
    }
    return { rows, columns, values: out };
  }

  const reshape = ({ values }, rows, columns) => ({ rows, columns, values });

  // zwfs.lowrank.Plane: functions that are combinations of products of a function of y and one of x.
  function plane(encoded) {
    const [y, x, combine] = [encoded.y, encoded.x, encoded.combine].map(matrix);
    const [yT, xT, combineT] = [y, x, combine].map(transpose);
    return {
      project: (map) => multiply(reshape(multiply(multiply(y, map), xT), 1, combine.rows), combine),
      expand: (coefficients) =>
        multiply(yT, multiply(reshape(multiply(coefficients, combineT), y.rows, x.rows), x)),
    };
  }

  const [ny, nx] = data.inside.shape;
  const inside = Int32Array.from([...decode(data.inside).entries()].flatMap(([k, value]) => (value ? [k] : [])));
  const nInside = inside.length;
  const pupil = plane(data.pupil);
  const detector = plane(data.detector);
  const cores = data.cores.map(matrix);
  const screens = plane(data.screens);
  const nSeeds = data.screens.combine.shape[1];

  // Complex maps are pairs of real ones.
  const field = () => [0, 1].map(() => ({ rows: ny, columns: nx, values: new Float64Array(ny * nx) }));

  // Transposed core of a dimple: the polynomial in the diameter through the ones that zwfs gave.
  function coreOf(diameter) {
    const weights = data.diameters.map((own) =>
      data.diameters.reduce((w, other) => (other === own ? w : (w * (diameter - other)) / (own - other)), 1),
    );
    const { rows, columns } = cores[0];
    const values = cores[0].values.map((_, k) => weights.reduce((sum, w, m) => sum + w * cores[m].values[k], 0));
    return transpose({ rows, columns, values });
  }

  // Light of a field in the pupil that goes through the dimple, on the detector.
  const through = (core, psi) => psi.map((part) => detector.expand(multiply(pupil.project(part), core)));

  // exp(i theta) - 1: a reference wave is this times the light through the dimple.
  const step = (theta) => [Math.cos(theta) - 1, Math.sin(theta)];

  function screen(seed, rms) {
    const pick = { rows: 1, columns: nSeeds, values: new Float64Array(nSeeds) };
    pick.values[seed - 1] = rms;
    const map = screens.expand(pick).values;
    const phase = new Float64Array(map.length);
    for (const k of inside) phase[k] = map[k];
    return phase;
  }

  function phasors(phase) {
    const psi = field();
    for (const k of inside) {
      psi[0].values[k] = Math.cos(phase[k]);
      psi[1].values[k] = Math.sin(phase[k]);
    }
    return psi;
  }

  function frame(psi, beta, [c, s]) {
    const [x, y] = beta.map((part) => part.values);
    const [re, im] = psi.map((part) => part.values);
    return re.map((_, k) => (re[k] + c * x[k] - s * y[k]) ** 2 + (im[k] + c * y[k] + s * x[k]) ** 2);
  }

  // Mulberry32: small, and good enough to draw pictures of noise.
  function generator(seed) {
    let state = seed | 0;
    return () => {
      state = (state + 0x6d2b79f5) | 0;
      let t = Math.imul(state ^ (state >>> 15), 1 | state);
      t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
      return ((t ^ (t >>> 14)) >>> 0) / 2 ** 32;
    };
  }

  function poisson(mean, random) {
    if (mean > NORMAL) {
      const normal = Math.sqrt(-2 * Math.log(1 - random())) * Math.cos(2 * Math.PI * random());
      return Math.max(0, Math.round(mean + Math.sqrt(mean) * normal));
    }
    const end = Math.exp(-mean);
    let count = 0;
    for (let product = random(); product > end; product *= random()) count++;
    return count;
  }

  function expose(frames, photons, seed) {
    if (photons === Infinity) return frames;
    const random = generator(seed);
    const perPixel = photons / nInside;
    return frames.map((intensity) => intensity.map((value) => poisson(value * perPixel, random) / perPixel));
  }

  // One iteration: reference waves of the estimate, then the two linear equations of every point. The estimate is
  // written to; returned is the number of points where they have no solution, which keep their phasor.
  function improve(estimate, core, frames, steps) {
    const [x, y] = through(core, estimate).map((part) => part.values);
    const [re, im] = estimate.map((part) => part.values);
    const [[ca, sa], [cb, sb]] = steps;
    let unsolved = 0;
    for (const k of inside) {
      const ax = ca * x[k] - sa * y[k];
      const ay = ca * y[k] + sa * x[k];
      const bx = cb * x[k] - sb * y[k];
      const by = cb * y[k] + sb * x[k];
      const powerA = ax * ax + ay * ay;
      const powerB = bx * bx + by * by;
      const determinant = ax * by - ay * bx;
      if (determinant ** 2 <= Math.max(PARALLEL ** 2 * powerA * powerB, DARK ** 2)) {
        unsolved++;
        continue;
      }
      const rightA = frames[0][k] - 1 - powerA;
      const rightB = frames[1][k] - 1 - powerB;
      const real = determinant * (rightA * by - rightB * ay);
      const imag = determinant * (rightB * ax - rightA * bx);
      const modulus = Math.sqrt(real * real + imag * imag);
      if (modulus > 0) {
        re[k] = real / modulus;
        im[k] = imag / modulus;
      }
    }
    return unsolved;
  }

  // Wrapped difference of the estimate and the truth without piston, its rms, and the estimate without piston.
  function compare(estimate, truth) {
    const [er, ei] = estimate.map((part) => part.values);
    const [tr, ti] = truth.map((part) => part.values);
    let [mr, mi] = [0, 0];
    for (const k of inside) {
      mr += er[k] * tr[k] + ei[k] * ti[k];
      mi += ei[k] * tr[k] - er[k] * ti[k];
    }
    const piston = Math.atan2(mi, mr);
    const [c, s] = [Math.cos(piston), Math.sin(piston)];
    const residual = new Float64Array(er.length);
    let sum = 0;
    for (const k of inside) {
      const re = er[k] * c + ei[k] * s;
      const im = ei[k] * c - er[k] * s;
      residual[k] = Math.atan2(im * tr[k] - re * ti[k], re * tr[k] + im * ti[k]);
      sum += residual[k] ** 2;
    }
    return { piston, residual, rms: Math.sqrt(sum / nInside) };
  }

  function strehl(psi) {
    const mean = psi.map((part) => inside.reduce((sum, k) => sum + part.values[k], 0) / nInside);
    return mean[0] ** 2 + mean[1] ** 2;
  }

  let kept = {}; // the core of the last diameter

  /* settings: rms (radian), seed (1 to nSeeds), diameter (lambda/D), shifts (two, radian), photons (in each image;
     Infinity: no noise), iterations. Maps are rows of ny x nx numbers, 0 outside the pupil:
     phase         input, radian
     frames        both images, 1 = mean intensity of the pupil with the mask out
     singular      whether the two shifts leave the equations without a solution; then all that follows is null
     estimate      phase found, radian, wrapped
     piston        of the estimate against the input, radian
     residual      estimate less input, on the circle and without piston, radian
     errors        rms of the residual at the start and after each iteration, radian
     unsolved      points without a solution in the last iteration */
  function compute({ rms, seed, diameter, shifts, photons, iterations }) {
    if (kept.diameter !== diameter) kept = { diameter, core: coreOf(diameter) };
    const { core } = kept;
    const steps = shifts.map(step);
    const phase = screen(seed, rms);
    const truth = phasors(phase);
    const beta = through(core, truth);
    const frames = expose(steps.map((change) => frame(truth, beta, change)), photons, seed);
    const made = { phase, frames, strehl: strehl(truth) };

    const estimate = phasors(new Float64Array(ny * nx));
    if (improve(phasors(phase.map(() => 0)), core, frames, steps) === nInside) {
      const none = { estimate: null, piston: null, residual: null, errors: null, unsolved: null };
      return { ...made, singular: true, ...none };
    }
    let found = compare(estimate, truth);
    const errors = [found.rms];
    let unsolved = 0;
    for (let i = 0; i < iterations; i++) {
      unsolved = improve(estimate, core, frames, steps);
      found = compare(estimate, truth);
      errors.push(found.rms);
    }
    const angle = estimate[0].values.map((re, k) => Math.atan2(estimate[1].values[k], re));
    const { piston, residual } = found;
    return { ...made, singular: false, estimate: angle, piston, residual, errors, unsolved };
  }

  const colors = Object.fromEntries(Object.entries(data.colors).map(([name, map]) => [name, decode(map)]));
  const sizes = { rank: cores[0].rows, functions: data.pupil.y.shape[0] };
  return { compute, colors, inside, shape: [ny, nx], sizes };
})();
