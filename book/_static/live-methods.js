// The reconstructors of the live page: linear, arcsine and phase-shifted, as in zwfs, and their errors.
"use strict";

(() => {
  const live = window.zwfsLive;
  const { inside, nInside, nQuarter, modes, map, mirrored, dots, accumulate } = live;
  const { project, expand, through, phasors } = live;
  const PARALLEL = 1e-6; // as in zwfs.PhaseShifted: sine below which two reference waves count as parallel,
  const DARK = 1e-9; // and amplitude below which one counts as absent
  const IN_LINE = 1e-6; // as in zwfs.Arcsine
  const CONDITIONING = 1e-3; // as in zwfs.Linear: smallest singular value that is inverted, relative to the largest
  const DIMMEST = 0.01; // as in the accelerated zwfs.PhaseShifted: least light that images miss, relative to flat ones,
  const MOST = 0.5; // and largest remainder of a small tilt
  const SMALL = 0.1; // tangents below it have their angle by a series

  // Solve L L^T x = b, with L in the lower half of rows.
  function solve(rows, b) {
    const x = Float64Array.from(b);
    const n = x.length;
    for (let i = 0; i < n; i++) {
      for (let j = 0; j < i; j++) x[i] -= rows[i][j] * x[j];
      x[i] /= rows[i][i];
    }
    for (let i = n - 1; i >= 0; i--) {
      x[i] /= rows[i][i];
      for (let j = 0; j < i; j++) x[j] -= rows[i][j] * x[i];
    }
    return x;
  }

  function cholesky(matrix) {
    const rows = matrix.map((row) => Float64Array.from(row));
    rows.forEach((row, i) => {
      for (let j = 0; j <= i; j++) {
        for (let k = 0; k < j; k++) row[j] -= row[k] * rows[j][k];
        row[j] = i === j ? Math.sqrt(row[j]) : row[j] / rows[j][j];
      }
    });
    return rows;
  }

  function dot(a, b) {
    let sum = 0;
    for (let k = 0; k < a.length; k++) sum += a[k] * b[k];
    return sum;
  }

  const unit = (a) => a.map((value) => value / Math.sqrt(dot(a, a)));

  // An extreme eigenvalue and its vector, by repeated application of a matrix or its inverse.
  function extreme(apply, n, times) {
    let vector = Float64Array.from({ length: n }, (_, k) => 1 + Math.sin(1 + 7 * k));
    for (let i = 0; i < times; i++) vector = unit(apply(vector));
    return [dot(vector, apply(vector)), vector];
  }

  // The linear method for dimples of one diameter. A mode z changes the image of a dimple with the phase shift theta by
  // 2 sin(theta) (b z - B z) around a flat wavefront, where B is the light through the dimple and b that of the flat
  // wavefront. So the least-squares problem is the same for all phase shifts, and falls apart into four classes. Two
  // images count as one: the mean of both signals, each divided by its sine, with the squared sines as weights.
  function linearFor(functions) {
    const ones = through(functions, phasors(map()), nInside)[0];
    const classes = modes.classes.map(({ start, places, columns }, kind) => {
      const own = functions.classes[kind].columns;
      const answers = columns.map((values) => {
        const answer = new Float64Array(nInside);
        for (let q = 0; q < nInside; q++) answer[q] = ones[q] * values[q];
        accumulate(answer, 0, nInside, own, dots(own, values, 0, nInside).map((sum) => -4 * sum));
        return answer;
      });
      const gram = answers.map((one, i) => dots(answers.slice(0, i + 1), one, 0, nInside).map((sum) => 4 * sum));
      const full = gram.map((row, i) => Float64Array.from(gram, (other, j) => (j > i ? other[i] : row[j])));
      const factor = cholesky(full);
      const n = gram.length;
      const [largest] = extreme((x) => Float64Array.from(full, (row) => dot(row, x)), n, 30);
      const [most, weakest] = extreme((x) => solve(factor, x), n, 4);
      return { start, places, answers, factor, largest, least: 1 / most, weakest };
    });
    const largest = Math.max(...classes.map((one) => one.largest));

    // Phase of a signal: the difference to the image of a flat wavefront, divided by the sine of the phase shift.
    return (signal) => {
      const sums = mirrored(signal, nInside);
      const coefficients = new Float64Array(modes.list.length);
      for (const { start, places, answers, factor, least, weakest } of classes) {
        let some = solve(factor, dots(answers, sums, start, nInside).map((sum) => sum / 2));
        if (least < CONDITIONING ** 2 * largest) {
          const share = dot(weakest, some);
          some = some.map((value, k) => value - share * weakest[k]);
        }
        some.forEach((value, k) => (coefficients[places[k]] = value));
      }
      return expand(coefficients, modes);
    };
  }

  // What the accelerated iteration needs to know of a dimple: the remainder of a small tilt after a plain iteration, and
  // inner products of light. A field is known by its real and imaginary coefficients, its projections on the functions W.
  // Their inner product is that of zwfs, of the parts of the fields in the span of W: that of the Gram matrix's inverse.
  function accelerationFor(functions, flat) {
    const tilt = map();
    for (const k of inside) tilt[k] = (live.places[k] % live.size) - (live.size - 1) / 2;
    const left = expand(project(tilt, functions), functions);
    const share = (term) => inside.reduce((sum, k) => sum + tilt[k] * term(k), 0);
    const remainder = share((k) => left[k] / flat[0][k]) / share((k) => tilt[k]);
    const gram = functions.list.map((_, i) => {
      const one = functions.list.map((_, j) => Number(i === j));
      return project(expand(one, functions, nQuarter), functions, nQuarter);
    });
    const factor = cholesky(gram);
    const inner = (a, b) => a.reduce((sum, part, p) => sum + dot(part, solve(factor, b[p])), 0);
    return { inner, relaxation: 1 / (1 - Math.min(Math.max(remainder, 0), MOST)) };
  }

  // Methods are { estimate, step }: the estimate is a field of modulus 1, which a step replaces.
  function linear({ flat, frames, steps, solveLinear }, nImages) {
    const used = steps.slice(0, nImages);
    const strength = used.reduce((sum, [, sine]) => sum + sine * sine, 0);
    if (strength < DARK ** 2) return null;
    const signal = map();
    used.forEach((step, m) => {
      const reference = live.intensity(live.behind(phasors(map()), flat, step));
      for (const k of inside) signal[k] += (step[1] * (frames[m][k] - reference[k])) / strength;
    });
    return { estimate: phasors(solveLinear(signal)), step: () => {} };
  }

  function arcsine({ functions, flat, frames, steps }) {
    const [c, s] = steps[0];
    if (c * c + s * s < DARK ** 2) return null;
    const estimate = phasors(map());
    const [re, im] = estimate;
    const side = map();
    for (const k of inside) {
      const [x, y] = [c * flat[0][k], s * flat[0][k]];
      side[k] = -y >= -IN_LINE * Math.hypot(x, y) ? 1 : -1;
    }
    const lightOf = plainly({ functions, flat });
    const step = () => {
      const [x, y] = lightOf(estimate);
      for (const k of inside) {
        const rx = c * x[k] - s * y[k];
        const ry = c * y[k] + s * x[k];
        const power = rx * rx + ry * ry;
        let along = (frames[0][k] - 1 - power) / 2;
        let across = power - along * along;
        if (across < 0) {
          along = Math.sign(along) * Math.sqrt(power);
          across = 0;
        }
        across = side[k] * Math.sqrt(across);
        re[k] = (along * rx - across * ry) / power;
        im[k] = (along * ry + across * rx) / power;
      }
    };
    return { estimate, step };
  }

  // One step of the phase-shifted method: the two linear equations of every point, for given light through the dimple.
  // Points without a solution keep their phasor; returned is their number.
  function solvePoints([re, im], [x, y], frames, [[ca, sa], [cb, sb]]) {
    let unsolved = 0;
    for (const k of inside) {
      const ax = ca * x[k] - sa * y[k];
      const ay = ca * y[k] + sa * x[k];
      const bx = cb * x[k] - sb * y[k];
      const by = cb * y[k] + sb * x[k];
      const powerA = ax * ax + ay * ay;
      const powerB = bx * bx + by * by;
      const determinant = ax * by - ay * bx;
      if (determinant * determinant <= Math.max(PARALLEL ** 2 * powerA * powerB, DARK ** 2)) {
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

  // Light through the dimple in each step of an iteration: that of a flat wavefront, then that of the estimate.
  function plainly({ functions, flat }) {
    let light = flat;
    return (estimate) => {
      const now = light ?? through(functions, estimate, nInside);
      light = null;
      return now;
    };
  }

  // The same for the accelerated iteration: dimmed in the first two steps (eq-dimming), then the secant (eq-secant).
  function extrapolated({ functions, flat, frames, steps, acceleration: { inner, relaxation } }) {
    const strength = steps.reduce((sum, [c, s]) => sum + c * c + s * s, 0);
    const lightOf = (coefficients) => coefficients.map((part) => expand(part, functions));
    const add = (a, factor, b) => a.map((part, p) => part.map((value, i) => value + factor * b[p][i]));

    // Light that the reference waves of coefficients take out of the pupil (eq-lost).
    function taken(coefficients, [x, y] = lightOf(coefficients)) {
      const total = coefficients.reduce((sum, part) => sum + dot(part, part), 0);
      return strength * inside.reduce((rest, k) => rest - x[k] * x[k] - y[k] * y[k], total);
    }

    let tried = phasors(map()).map((part) => project(part, functions));
    const most = taken(tried, flat);
    const seen = frames.reduce((sum, frame) => inside.reduce((rest, k) => rest + 1 - frame[k], sum), 0);
    const missing = Math.min(Math.max(seen, DIMMEST * most), most);
    const dimmed = (coefficients) => {
      const factor = Math.sqrt(missing / Math.max(taken(coefficients), DIMMEST * missing));
      return coefficients.map((part) => part.map((value) => factor * value));
    };

    let [before, change] = [null, null];
    function secant(x, f) {
      let next = add(x, relaxation, f);
      if (before) {
        const turn = add(f, -1, change);
        const share = inner(turn, f) / (inner(turn, turn) || 1);
        next = add(next, -share, add(add(x, -1, before), relaxation, turn));
      }
      [before, change] = [x, f];
      return next;
    }

    let step = 0;
    return (estimate) => {
      const own = estimate.map((part) => project(part, functions));
      if (step === 0) tried = dimmed(tried);
      else if (step === 1) tried = dimmed(add(tried, relaxation, add(own, -1, tried)));
      else {
        const across = [own[1], own[0].map((value) => -value)];
        const piston = Math.atan2(inner(tried, across), inner(tried, own));
        const cosine = own.map((part) => part.map((value) => Math.cos(piston) * value));
        tried = secant(tried, add(add(cosine, Math.sin(piston), across), -1, tried));
      }
      step++;
      return lightOf(tried);
    };
  }

  function phaseShifted(problem, lightOf = plainly(problem)) {
    const { flat, frames, steps } = problem;
    const estimate = phasors(map());
    if (solvePoints(phasors(map()), flat, frames, steps) === inside.length) return null;
    return { estimate, step: () => solvePoints(estimate, lightOf(estimate), frames, steps) };
  }

  const accelerated = (problem) => phaseShifted(problem, extrapolated(problem));

  function angle(y, x) {
    if (x <= 0 || Math.abs(y) > SMALL * x) return Math.atan2(y, x);
    const t = y / x;
    const square = t * t;
    return t * (1 - square * (1 / 3 - square * (1 / 5 - square / 7)));
  }

  // Difference of estimate and truth on the circle, without piston, and its rms; the map is filled if there is one.
  function compare([er, ei], [tr, ti], residual = null) {
    let [mr, mi] = [0, 0];
    for (const k of inside) {
      mr += er[k] * tr[k] + ei[k] * ti[k];
      mi += ei[k] * tr[k] - er[k] * ti[k];
    }
    const modulus = Math.hypot(mr, mi) || 1;
    const [c, s] = [mr / modulus, mi / modulus];
    let sum = 0;
    for (const k of inside) {
      const re = er[k] * tr[k] + ei[k] * ti[k];
      const im = ei[k] * tr[k] - er[k] * ti[k];
      const turn = angle(im * c - re * s, re * c + im * s);
      sum += turn * turn;
      if (residual) residual[k] = turn;
    }
    return Math.sqrt(sum / inside.length);
  }

  // Errors at the start and after each iteration, and the last residual.
  function follow(method, truth, iterations) {
    if (!method) return null;
    const errors = [compare(method.estimate, truth)];
    for (let i = 0; i < iterations; i++) {
      method.step();
      errors.push(compare(method.estimate, truth));
    }
    const residual = map();
    errors[iterations] = compare(method.estimate, truth, residual);
    return { estimate: method.estimate, errors, residual };
  }

  const kept = {}; // what belongs to the last wavefront and the last diameter

  function wavefront(seed, rms) {
    if (kept.seed !== seed) Object.assign(kept, { seed, screen: live.screen(seed), rms: null });
    if (kept.rms !== rms) {
      const phase = kept.screen.map((value) => value * rms);
      const truth = phasors(phase);
      const wave = { phase, truth, strehl: live.strehl(truth), focal: live.focalPlane(truth) };
      Object.assign(kept, { rms, wavefront: wave });
    }
    return kept.wavefront;
  }

  function dimple(diameter) {
    if (kept.diameter !== diameter) {
      const functions = live.dimple(diameter);
      const flat = through(functions, phasors(map()));
      const prepared = { solveLinear: linearFor(functions), acceleration: accelerationFor(functions, flat) };
      Object.assign(kept, { diameter, dimple: { functions, flat, ...prepared } });
    }
    return kept.dimple;
  }

  /* settings: rms (radian), seed (1 to nSeeds), diameter (lambda/D), shifts (two, radian), photons (that an
     intensity of 1 puts into a pixel of each image; Infinity: no noise), iterations, both (whether the linear method
     uses both images), accelerated and likelihood (whether to compute them). Maps are those of live-model.js:
     phase         input, radian
     strehl        of the input
     focal         intensity in the focal plane, rows
     frames        both images, 1 = mean intensity of the pupil with the mask out
     linear, arcsine, shifted, accelerated, likelihood
                   estimate (field), residual (estimate less input on the circle, without piston, radian) and errors
                   (rms of the residual at the start and after each iteration, radian); null without a solution */
  live.compute = ({ rms, seed, diameter, shifts, photons, iterations, ...set }) => {
    const { phase, truth, strehl, focal } = wavefront(seed, rms);
    const model = dimple(diameter);
    const steps = shifts.map(live.step);
    const light = through(model.functions, truth);
    const clean = steps.map((change) => live.intensity(live.behind(truth, light, change)));
    const frames = live.expose(clean, photons, seed);
    const problem = { ...model, frames, steps, perPixel: photons };
    return {
      ...{ phase, strehl, focal, frames },
      linear: follow(linear(problem, set.both ? 2 : 1), truth, 0),
      arcsine: follow(arcsine(problem), truth, iterations),
      shifted: follow(phaseShifted(problem), truth, iterations),
      accelerated: set.accelerated ? follow(accelerated(problem), truth, iterations) : null,
      likelihood: set.likelihood ? follow(live.maximise(problem), truth, iterations) : null,
    };
  };

  Object.assign(live, { accelerated, compare });
})();
