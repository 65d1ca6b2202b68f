// The sensor of the live page: wavefronts, images and the focal plane, in the numbers that zwfs gave (live-data.js).
// No page is touched here, nor in live-methods.js and live-likelihood.js.
//
// Pupil and detector are symmetric. A map is stored in four blocks of one quarter each: that with x, y > 0, then its
// mirror images, of x, of y, and of both. Quarters begin with the points inside the pupil. Functions that are even or
// odd in x and y are known by their class, 2 (odd in y) + (odd in x), and their values in the first quarter.
"use strict";

window.zwfsLive = (() => {
  const TYPES = { uint8: Uint8Array, float32: Float32Array, float64: Float64Array };
  const SMALLEST = 1e-7; // of the light through a dimple, relative to its strongest part: what is less is left out
  const NORMAL = 30; // mean number of photons above which Poisson's distribution is taken to be normal
  const FOCAL = { size: 48, reach: 4 }; // pixels, and lambda/D from the axis to the edge

  const data = window.zwfsLiveData;

  function decode({ type, values }) {
    return new TYPES[type](Uint8Array.from(atob(values), (letter) => letter.charCodeAt(0)).buffer);
  }

  // The points of the first quarter, and the place of every value of a map in rows from below.
  const size = data.inside.shape[0];
  const half = size / 2;
  const flags = decode(data.inside);
  const points = Array.from({ length: half * half }, (_, k) => [half + Math.floor(k / half), half + (k % half)]);
  const isInside = ([y, x]) => flags[y * size + x] === 1;
  const quarter = [...points.filter(isInside), ...points.filter((point) => !isInside(point))];
  const nQuarter = quarter.length;
  const nInside = points.filter(isInside).length; // of a quarter
  const places = Int32Array.from({ length: 4 * nQuarter }, (_, k) => {
    const [y, x] = quarter[k % nQuarter];
    const block = Math.floor(k / nQuarter);
    return (block & 2 ? size - 1 - y : y) * size + (block & 1 ? size - 1 - x : x);
  });
  const inside = Int32Array.from({ length: 4 * nInside }, (_, k) => Math.floor(k / nInside) * nQuarter + (k % nInside));

  const map = () => new Float64Array(4 * nQuarter);
  const field = () => [map(), map()]; // real and imaginary part

  // Sums of the four mirror images of a map with the signs of each class; of classes, the map that they make.
  function mirrored(from, n) {
    const to = map();
    for (let q = 0; q < n; q++) {
      const even = from[q] + from[nQuarter + q];
      const odd = from[q] - from[nQuarter + q];
      const evenBelow = from[2 * nQuarter + q] + from[3 * nQuarter + q];
      const oddBelow = from[2 * nQuarter + q] - from[3 * nQuarter + q];
      to[q] = even + evenBelow;
      to[nQuarter + q] = odd + oddBelow;
      to[2 * nQuarter + q] = even - evenBelow;
      to[3 * nQuarter + q] = odd - oddBelow;
    }
    return to;
  }

  // Inner products of numbers with columns, and their sum with factors, four at a time: that is twice as fast.
  function dots(columns, from, start, n) {
    const sums = new Float64Array(columns.length);
    const whole = columns.length - (columns.length % 4);
    for (let c = 0; c < whole; c += 4) {
      const [u, v, w, x] = columns.slice(c, c + 4);
      let [a, b, d, e] = [0, 0, 0, 0];
      for (let q = 0; q < n; q++) {
        const value = from[start + q];
        a += u[q] * value;
        b += v[q] * value;
        d += w[q] * value;
        e += x[q] * value;
      }
      sums.set([a, b, d, e], c);
    }
    for (let c = whole; c < columns.length; c++) {
      const u = columns[c];
      let a = 0;
      for (let q = 0; q < n; q++) a += u[q] * from[start + q];
      sums[c] = a;
    }
    return sums;
  }

  function accumulate(to, start, n, columns, factors) {
    const whole = columns.length - (columns.length % 4);
    for (let c = 0; c < whole; c += 4) {
      const [u, v, w, x] = columns.slice(c, c + 4);
      const [a, b, d, e] = factors.slice(c, c + 4);
      for (let q = 0; q < n; q++) to[start + q] += a * u[q] + b * v[q] + d * w[q] + e * x[q];
    }
    for (let c = whole; c < columns.length; c++) {
      const [u, a] = [columns[c], factors[c]];
      for (let q = 0; q < n; q++) to[start + q] += a * u[q];
    }
  }

  // Functions [{ kind, values }], and for each class its columns of values and their places among the functions.
  const grouped = (list) => ({
    list,
    classes: [0, 1, 2, 3].map((kind) => {
      const some = list.flatMap((one, place) => (one.kind === kind ? [place] : []));
      return { start: kind * nQuarter, places: some, columns: some.map((place) => list[place].values) };
    }),
  });

  // Inner products of a map with functions, over the pupil or the whole detector.
  function project(from, { list, classes }, n = nInside) {
    const sums = mirrored(from, n);
    const coefficients = new Float64Array(list.length);
    for (const { start, places: some, columns } of classes)
      dots(columns, sums, start, n).forEach((value, c) => (coefficients[some[c]] = value));
    return coefficients;
  }

  // Map of coefficients of functions.
  function expand(coefficients, { classes }, n = nInside) {
    const sums = map();
    for (const { start, places: some, columns } of classes)
      accumulate(sums, start, n, columns, Float64Array.from(some, (place) => coefficients[place]));
    return mirrored(sums, n);
  }

  // The functions f_y(y) f_x(x) of each class that the cores couple.
  const [nFunctions] = data.functions.shape;
  const axis = decode(data.functions);
  const products = [0, 1, 2, 3].map((kind) => {
    const orders = Array.from({ length: (nFunctions / 2) ** 2 }, (_, k) => [
      2 * Math.floor((2 * k) / nFunctions) + (kind >> 1),
      2 * (k % (nFunctions / 2)) + (kind & 1),
    ]);
    return orders.map(([i, j]) => Float64Array.from(quarter, ([y, x]) => axis[i * size + y] * axis[j * size + x]));
  });
  const nProducts = products[0].length;
  const cores = decode(data.cores);

  // Core of one class at a diameter: the polynomial through the cores that zwfs gave, of which it stored one half.
  function coreOf(diameter, kind) {
    const weights = data.diameters.map((own) =>
      data.diameters.reduce((w, other) => (other === own ? w : (w * (diameter - other)) / (own - other)), 1),
    );
    const core = new Float64Array(nProducts ** 2);
    const nPairs = (nProducts * (nProducts + 1)) / 2;
    for (let i = 0, pair = 0; i < nProducts; i++)
      for (let j = 0; j <= i; j++, pair++) {
        const value = weights.reduce((sum, weight, m) => sum + weight * cores[(4 * m + kind) * nPairs + pair], 0);
        core[i * nProducts + j] = core[j * nProducts + i] = value;
      }
    return core;
  }

  // Functions W of a dimple, strongest first: the light of a field psi through it is W W^T psi. They are products
  // times the columns of a Cholesky factor of the core, which is made with the largest pivot first.
  function dimple(diameter) {
    const columns = [0, 1, 2, 3].flatMap((kind) => {
      const core = coreOf(diameter, kind);
      const found = [];
      for (;;) {
        let best = 0;
        for (let k = 1; k < nProducts; k++) if (core[k * (nProducts + 1)] > core[best * (nProducts + 1)]) best = k;
        const pivot = core[best * (nProducts + 1)];
        if (found.length === nProducts || pivot <= SMALLEST * (found[0]?.pivot ?? 0) || pivot <= 0) return found;
        const root = Math.sqrt(pivot);
        const column = Float64Array.from({ length: nProducts }, (_, k) => core[k * nProducts + best] / root);
        for (let i = 0; i < nProducts; i++)
          for (let j = 0; j < nProducts; j++) core[i * nProducts + j] -= column[i] * column[j];
        found.push({ kind, pivot, column });
      }
    });
    columns.sort((a, b) => b.pivot - a.pivot);
    const strong = columns.filter(({ pivot }) => pivot > SMALLEST * columns[0].pivot);
    return grouped(
      strong.map(({ kind, pivot, column }) => {
        const values = new Float64Array(nQuarter);
        accumulate(values, 0, nQuarter, products[kind], column);
        return { kind, pivot, values };
      }),
    );
  }

  // Light of a field in the pupil that goes through the dimple, on the detector or on the pupil alone.
  const through = (functions, psi, n = nQuarter) =>
    psi.map((part) => expand(project(part, functions), functions, n));

  // exp(i theta) - 1: a reference wave is this times the light through the dimple.
  const step = (theta) => [Math.cos(theta) - 1, Math.sin(theta)];

  // Zernike modes as in zwfs.zernike_basis, with Jacobi polynomials for the radial part.
  function zernike([n, m]) {
    const kind = m >= 0 ? m & 1 : 2 | (1 - (m & 1));
    const order = Math.abs(m);
    const values = new Float64Array(nQuarter);
    for (let q = 0; q < nInside; q++) {
      const [y, x] = quarter[q].map((k) => (2 * (k - (size - 1) / 2)) / size);
      const t = 2 * (x * x + y * y) - 1;
      let [before, radial] = [0, 1];
      for (let k = 1; k <= (n - order) / 2; k++) {
        const c = 2 * k + order;
        const next =
          k === 1
            ? ((order + 2) * t - order) / 2
            : ((c - 1) * (c * (c - 2) * t - order * order) * radial - 2 * (k - 1) * (k + order - 1) * c * before) /
              (2 * k * (k + order) * (c - 2));
        [before, radial] = [radial, next];
      }
      const angle = order * Math.atan2(y, x);
      values[q] = radial * Math.hypot(x, y) ** order * (m >= 0 ? Math.cos(angle) : Math.sin(angle));
    }
    const mean = kind ? 0 : values.reduce((sum, value) => sum + value, 0) / nInside;
    for (let q = 0; q < nInside; q++) values[q] -= mean;
    const rms = Math.sqrt(values.reduce((sum, value) => sum + value * value, 0) / nInside);
    return { kind, values: values.map((value) => value / rms) };
  }

  const modes = grouped(data.orders.map(zernike));
  const screens = decode(data.screens);
  const nModes = modes.list.length;
  const screen = (seed) => expand(screens.subarray((seed - 1) * nModes, seed * nModes), modes);

  function phasors(phase) {
    const psi = field();
    for (const k of inside) {
      psi[0][k] = Math.cos(phase[k]);
      psi[1][k] = Math.sin(phase[k]);
    }
    return psi;
  }

  // Field behind a dimple with the step [c, s].
  function behind([re, im], [x, y], [c, s]) {
    const [outRe, outIm] = field();
    for (let k = 0; k < re.length; k++) {
      outRe[k] = re[k] + c * x[k] - s * y[k];
      outIm[k] = im[k] + c * y[k] + s * x[k];
    }
    return [outRe, outIm];
  }

  function intensity([re, im]) {
    const out = map();
    for (let k = 0; k < out.length; k++) out[k] = re[k] * re[k] + im[k] * im[k];
    return out;
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

  // Images with photon noise; perPixel is the number of photons that an intensity of 1 puts into a pixel of each.
  function expose(frames, perPixel, seed) {
    if (perPixel === Infinity) return frames;
    const random = generator(seed);
    return frames.map((frame) => frame.map((value) => poisson(value * perPixel, random) / perPixel));
  }

  function strehl(psi) {
    const mean = psi.map((part) => inside.reduce((sum, k) => sum + part[k], 0) / inside.length);
    return mean[0] ** 2 + mean[1] ** 2;
  }

  // Intensity in the focal plane, rows from below; 1 is the peak of a flat wavefront.
  const waves = Array.from({ length: FOCAL.size }, (_, f) => {
    const frequency = (FOCAL.reach * (2 * f + 1 - FOCAL.size)) / FOCAL.size;
    const turns = Array.from({ length: size }, (_, k) => -2 * Math.PI * frequency * ((k - (size - 1) / 2) / size));
    return [Float64Array.from(turns, Math.cos), Float64Array.from(turns, Math.sin)];
  });

  function focalPlane(psi) {
    const rows = [0, 1].map(() => new Float64Array(size * size));
    for (const k of inside) for (const part of [0, 1]) rows[part][places[k]] = psi[part][k];
    const light = new Float64Array(FOCAL.size ** 2);
    const along = [0, 1].map(() => new Float64Array(size));
    waves.forEach(([cosU, sinU], u) => {
      for (let y = 0; y < size; y++) {
        let [re, im] = [0, 0];
        for (let x = 0, k = y * size; x < size; x++, k++) {
          re += rows[0][k] * cosU[x] - rows[1][k] * sinU[x];
          im += rows[0][k] * sinU[x] + rows[1][k] * cosU[x];
        }
        along[0][y] = re;
        along[1][y] = im;
      }
      waves.forEach(([cosV, sinV], v) => {
        let [re, im] = [0, 0];
        for (let y = 0; y < size; y++) {
          re += along[0][y] * cosV[y] - along[1][y] * sinV[y];
          im += along[0][y] * sinV[y] + along[1][y] * cosV[y];
        }
        light[v * FOCAL.size + u] = (re * re + im * im) / inside.length ** 2;
      });
    });
    return light;
  }

  const colors = Object.fromEntries(Object.entries(data.colors).map(([name, encoded]) => [name, decode(encoded)]));
  return {
    ...{ size, places, inside, nQuarter, nInside, modes, colors, designs: data.designs, FOCAL },
    ...{ map, field, mirrored, dots, accumulate, grouped, project, expand },
    ...{ dimple, through, step, screen, phasors, behind, intensity, expose, strehl, focalPlane },
  };
})();
