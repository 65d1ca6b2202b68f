// Maximum likelihood on the live page, as in zwfs.MaximumLikelihood from its first start: Levenberg-Marquardt steps on
// the phase of every point, whose Hessian is a diagonal plus a matrix of low rank.
"use strict";

(() => {
  const live = window.zwfsLive;
  const { inside, nInside, nQuarter, map, field, mirrored, project, expand, through, behind, intensity } = live;
  const FIRST_ITERATIONS = 2; // of the accelerated iteration
  const COARSE = 1e-3; // weakest function of the dimple in the Hessian, relative to the strongest
  const DAMPING = 1e-3; // of the first step, relative to the mean of the information's diagonal
  const LEAST_CUT = 0.1; // of the damping after a good step
  const GROWTH = 2; // of the damping after a first step that raises the cost
  const TOLERANCE = 1e-5; // radian rms: a smaller step is the last one
  const NEGLIGIBLE = 1e-3; // of the mean standard error: so is a smaller step than that
  const RESIDUAL = 1e-5; // rms of the images, up to which those without noise are explained
  const REFLECTIONS = 3; // largest number of times that points are reflected
  const GAIN = 0.01; // of twice the logarithm of the likelihood, from which on a reflection counts
  const SMALLEST = 1e-12; // of the diagonal, relative to its mean
  const NO_LIGHT = 1e-12; // photons: a darker pixel counts as this bright

  const all = Int32Array.from({ length: 4 * nQuarter }, (_, k) => k);
  const sum = (places, term) => {
    let total = 0;
    for (const k of places) total += term(k);
    return total;
  };

  // A map with values at some places, 0 elsewhere.
  function at(places, term) {
    const to = map();
    for (const k of places) to[k] = term(k);
    return to;
  }

  // Terms of the cost, twice the negative logarithm of the likelihood; without noise, squares.
  function term(light, frame, perPixel) {
    if (perPixel === Infinity) return (light - frame) ** 2;
    const [expected, seen] = [perPixel * light + NO_LIGHT, perPixel * frame + NO_LIGHT];
    return 2 * (expected - seen + seen * Math.log(seen / expected));
  }

  const weight = (light, perPixel) => (perPixel === Infinity ? 1 : perPixel ** 2 / (perPixel * light + NO_LIGHT));

  // Model of the images at a field, and its cost.
  function model(psi, { functions, frames, steps, perPixel }) {
    const light = through(functions, psi);
    const waves = steps.map((step) => behind(psi, light, step));
    const images = waves.map(intensity);
    const cost = images.reduce((total, image, m) => total + sum(all, (k) => term(image[k], frames[m][k], perPixel)), 0);
    return { psi, waves, images, cost };
  }

  // Inner products of all pairs of functions, weighted with maps: one matrix, as rows, for each map.
  function grams(maps, functions, n) {
    const sums = maps.map((one) => mirrored(one, n));
    const size = functions.list.length;
    const matrices = maps.map(() => functions.list.map(() => new Float64Array(size)));
    const product = new Float64Array(n);
    functions.list.forEach((a, i) => {
      for (let j = 0; j <= i; j++) {
        const b = functions.list[j];
        const start = (a.kind ^ b.kind) * nQuarter;
        for (let q = 0; q < n; q++) product[q] = a.values[q] * b.values[q];
        sums.forEach((values, m) => {
          let total = 0;
          for (let q = 0; q < n; q++) total += product[q] * values[start + q];
          matrices[m][i][j] = matrices[m][j][i] = total;
        });
      }
    });
    return matrices;
  }

  // Solution of a symmetric, indefinite system, by elimination with the largest pivot; both arguments are used up.
  function eliminate(rows, right) {
    const n = right.length;
    for (let i = 0; i < n; i++) {
      let best = i;
      for (let k = i + 1; k < n; k++) if (Math.abs(rows[k][i]) > Math.abs(rows[best][i])) best = k;
      [rows[i], rows[best]] = [rows[best], rows[i]];
      [right[i], right[best]] = [right[best], right[i]];
      for (let k = i + 1; k < n; k++) {
        const factor = rows[k][i] / rows[i][i];
        if (!factor) continue;
        for (let j = i; j < n; j++) rows[k][j] -= factor * rows[i][j];
        right[k] -= factor * right[i];
      }
    }
    for (let i = n - 1; i >= 0; i--) {
      for (let j = i + 1; j < n; j++) right[i] -= rows[i][j] * right[j];
      right[i] /= rows[i][i];
    }
    return right;
  }

  // Information F = L + K B^T + B K^T + K M K^T about the phases (eq-information of the book), where K and B are
  // functions times maps, and half the gradient of the cost.
  function information({ psi, waves, images }, { functions, frames, steps, perPixel }, coarse) {
    const tangent = [at(inside, (k) => -psi[1][k]), at(inside, (k) => psi[0][k])];
    const local = map();
    const mixed = field();
    const squares = [map(), map(), map()];
    const back = field();
    const passed = field();
    waves.forEach(([x, y], m) => {
      const [c, s] = steps[m];
      const seen = field();
      for (const k of all) {
        const w = weight(images[m][k], perPixel);
        const [a, b] = [2 * (x[k] * c + y[k] * s), 2 * (y[k] * c - x[k] * s)];
        squares[0][k] += w * a * a;
        squares[1][k] += w * a * b;
        squares[2][k] += w * b * b;
        const change = 2 * (x[k] * tangent[0][k] + y[k] * tangent[1][k]);
        local[k] += w * change * change;
        mixed[0][k] += w * a * change;
        mixed[1][k] += w * b * change;
        const difference = w * (images[m][k] - frames[m][k]);
        seen[0][k] = x[k] * difference;
        seen[1][k] = y[k] * difference;
        back[0][k] += seen[0][k];
        back[1][k] += seen[1][k];
        passed[0][k] += c * seen[0][k] + s * seen[1][k];
        passed[1][k] += c * seen[1][k] - s * seen[0][k];
      }
    });
    passed.forEach((part, p) => {
      const spread = expand(project(part, functions, nQuarter), functions);
      for (const k of inside) back[p][k] += spread[k];
    });
    const gradient = at(inside, (k) => 2 * (tangent[0][k] * back[0][k] + tangent[1][k] * back[1][k]));
    const scale = sum(inside, (k) => local[k]) / inside.length;
    const [aa, ab, bb] = grams(squares, coarse, nQuarter);
    return { local, sets: [...tangent, ...mixed], grams: [[aa, ab], [ab, bb]], gradient, scale };
  }

  // Levenberg-Marquardt step by Woodbury's identity (eq-woodbury). The piston, which no image shows, is fixed.
  function newStep({ local, sets, grams: shown, gradient, scale }, damping, coarse) {
    const r = coarse.list.length;
    const inverse = at(inside, (k) => 1 / (local[k] + (SMALLEST + damping) * scale));
    const pairs = [0, 1, 2, 3].flatMap((i) => [0, 1, 2, 3].filter((j) => j <= i).map((j) => [i, j]));
    const maps = pairs.map(([i, j]) => at(inside, (k) => sets[i][k] * sets[j][k] * inverse[k]));
    const size = 4 * r + 1;
    const rows = Array.from({ length: size }, () => new Float64Array(size));
    grams(maps, coarse, nInside).forEach((block, p) => {
      const [i, j] = pairs[p];
      for (let a = 0; a < r; a++)
        for (let b = 0; b < r; b++) rows[i * r + a][j * r + b] = rows[j * r + b][i * r + a] = block[a][b];
    });
    for (let a = 0; a < 2 * r; a++) {
      rows[a][2 * r + a] += 1;
      rows[2 * r + a][a] += 1;
      for (let b = 0; b < 2 * r; b++)
        rows[2 * r + a][2 * r + b] -= shown[Math.floor(a / r)][Math.floor(b / r)][a % r][b % r];
    }
    const gauge = Math.sqrt(scale / inside.length);
    const onto = (values) =>
      sets.flatMap((one) => [...project(at(inside, (k) => one[k] * values[k] * inverse[k]), coarse)]);
    onto(map().fill(gauge)).forEach((value, a) => (rows[a][4 * r] = rows[4 * r][a] = value));
    rows[4 * r][4 * r] = 1 + gauge ** 2 * sum(inside, (k) => inverse[k]);
    const right = [...onto(gradient), gauge * sum(inside, (k) => gradient[k] * inverse[k])];
    const weights = eliminate(rows, right);
    const waves = sets.map((_, i) => expand(weights.slice(i * r, (i + 1) * r), coarse));
    const step = at(inside, (k) => {
      const low = sets.reduce((total, one, i) => total + one[k] * waves[i][k], gauge * weights[4 * r]);
      return inverse[k] * (low - gradient[k]);
    });
    const promised = sum(inside, (k) => step[k] * (damping * scale * step[k] - gradient[k]));
    return { step, promised };
  }

  // Field turned by a phase, for small ones exactly by it: the factor (1 + i x / 2) / (1 - i x / 2).
  function turned([re, im], by) {
    const out = field();
    for (const k of inside) {
      const half = by[k] / 2;
      const sine = by[k] / (1 + half * half);
      const cosine = 1 - half * sine;
      out[0][k] = cosine * re[k] - sine * im[k];
      out[1][k] = sine * re[k] + cosine * im[k];
    }
    return out;
  }

  // Points may have converged to the reflection of their phasor at a reference wave, which gives the same intensity in
  // one image. Each takes the reflection that makes its images most likely (eq-reflection).
  function reflected({ psi, waves, images }, { frames, perPixel }, gain) {
    const out = field();
    const cost = (re, im, k, references) =>
      references.reduce(
        (total, [x, y], m) => total + term((re + x) ** 2 + (im + y) ** 2, frames[m][k], perPixel),
        0,
      );
    for (const k of inside) {
      const [re, im] = [psi[0][k], psi[1][k]];
      const references = waves.map(([x, y]) => [x[k] - re, y[k] - im]);
      let least = images.reduce((total, image, m) => total + term(image[k], frames[m][k], perPixel), 0);
      [out[0][k], out[1][k]] = [re, im];
      for (const [x, y] of references) {
        const power = x * x + y * y + Number.MIN_VALUE;
        const [c, s] = [(x * x - y * y) / power, (2 * x * y) / power];
        const [otherRe, otherIm] = [c * re + s * im, s * re - c * im];
        const own = cost(otherRe, otherIm, k, references);
        if (own < least - gain) {
          least = own;
          [out[0][k], out[1][k]] = [otherRe, otherIm];
        }
      }
    }
    return out;
  }

  // The method as { estimate, step }; null if neither dimple changes the light.
  live.maximise = (problem) => {
    const { functions, perPixel } = problem;
    if (problem.steps.every(([c, s]) => c * c + s * s < 1e-18)) return null;
    const strongest = functions.list[0].pivot;
    const coarse = live.grouped(functions.list.filter(({ pivot }) => pivot > COARSE * strongest));
    const first = live.accelerated(problem);
    const method = { estimate: first?.estimate ?? live.phasors(map()), converged: false };
    const nPixels = 2 * all.length;
    let [iteration, damping, growth, reflections, fit] = [0, DAMPING, GROWTH, 0, null];

    function improve() {
      fit ??= model(method.estimate, problem);
      const info = information(fit, problem, coarse);
      const { step, promised } = newStep(info, damping, coarse);
      const trial = model(turned(fit.psi, step), problem);
      if (trial.cost < fit.cost) {
        const ratio = (fit.cost - trial.cost) / promised;
        damping *= Math.max(LEAST_CUT, 1 - (2 * ratio - 1) ** 3);
        growth = GROWTH;
        fit = trial;
      } else {
        damping *= growth;
        growth *= 2;
      }
      const size = Math.sqrt(sum(inside, (k) => step[k] ** 2) / inside.length);
      const negligible = perPixel === Infinity ? 0 : NEGLIGIBLE / Math.sqrt(info.scale);
      method.converged = size <= Math.max(TOLERANCE, negligible);
    }

    function reflect() {
      const explained = perPixel === Infinity && fit.cost <= RESIDUAL ** 2 * nPixels;
      if (explained || reflections++ >= REFLECTIONS) return;
      const gain = GAIN * (perPixel === Infinity ? fit.cost / (nPixels - inside.length + 1) : 1);
      const trial = model(reflected(fit, problem, gain), problem);
      if (trial.cost >= fit.cost - gain) return;
      [fit, damping, method.converged] = [trial, DAMPING, false];
    }

    method.step = () => {
      if (first && iteration < FIRST_ITERATIONS) first.step();
      else if (!method.converged) {
        improve();
        if (method.converged) reflect();
        method.estimate = fit.psi;
      }
      iteration++;
    };
    return method;
  };
})();
