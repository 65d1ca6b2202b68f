// The page of the live sensor (live.md): sliders, presets and the address in, maps and numbers out.
// live-methods.js computes what is shown; live-maps.js draws it.
"use strict";

(() => {
  const live = window.zwfsLive;
  const { draw } = live;
  const PAUSE = 800; // ms without a change before the numbers are read out
  const FOLLOW = 500; // ms between changes of the address: browsers count them
  const TURN = 250; // ms of each iteration that is played
  const AGREE = 0.5; // rad: a phase that is nearer to the input, on the circle, is shown on its branch
  const TOLERATED = 0.05; // error that counts as a success, relative to the input, as in the paper
  const NO_USE = (0.85 * Math.PI) / Math.sqrt(3); // rad rms: an error that is hardly smaller than that of random phases

  const find = (name) => document.getElementById(`live-${name}`);
  const inputs = [...document.querySelectorAll("#live .live-controls input")];
  const nameOf = (input) => input.id.replace("live-", "");
  const value = (name) => Number(find(name).value);
  const signed = (number, digits) => `${number < 0 ? "−" : "+"}${Math.abs(number).toFixed(digits)}`;

  // What is written above a slider, and what a screen reader says.
  const photons = () => (value("per-point") < find("per-point").max ? 10 ** value("per-point") : Infinity);
  const captions = {
    rms: (v) => [`${v.toFixed(2)} rad`],
    seed: (v) => [`${v}`],
    diameter: (v) => [`${v.toFixed(2)} λ/D`, `${v.toFixed(2)} lambda over D`],
    "shift-a": (v) => [`${signed(v, 2)} π`, `${v.toFixed(2)} pi`],
    "shift-b": (v) => [`${signed(v, 2)} π`, `${v.toFixed(2)} pi`],
    "per-point": () => (photons() === Infinity ? ["∞", "no noise"] : [`${Number(photons().toPrecision(2))}`]),
    iterations: (v) => [`${v}`],
  };

  function caption(input) {
    if (input.type === "checkbox") return;
    const [seen, spoken] = captions[nameOf(input)](Number(input.value));
    input.parentElement.querySelector("output").textContent = seen;
    input.setAttribute("aria-valuetext", spoken ?? seen);
  }

  // The state is text by the name of each control. Only what differs from the default stands in the address.
  const read = (input) => (input.type === "checkbox" ? String(Number(input.checked)) : input.value);
  const standard = (input) => (input.type === "checkbox" ? String(Number(input.defaultChecked)) : input.defaultValue);

  function write(input, text) {
    if (input.type === "checkbox") input.checked = text === "1";
    else if (text !== "" && Number.isFinite(Number(text))) input.value = text; // the browser keeps it in its range
    caption(input);
  }

  // Change some controls; all others keep their value, or take their default.
  function set(changes, others = read) {
    for (const input of inputs) write(input, changes[nameOf(input)] ?? others(input));
    ask();
  }

  // The slider `photons` of old addresses counted those of all points: the logarithm is less by 3.5, to 2 %.
  function parse(text) {
    const { photons: old, ...state } = Object.fromEntries(new URLSearchParams(text));
    return old ? { "per-point": String(old - 3.5), ...state } : state;
  }

  const changed = () => inputs.filter((input) => read(input) !== standard(input));

  function toAddress() {
    const state = new URLSearchParams(changed().map((input) => [nameOf(input), read(input)]));
    const bare = location.href.replace(/#.*/, "");
    history.replaceState(null, "", changed().length ? `${bare}#${state}` : bare);
  }

  // An address without a state, such as that of a heading, changes nothing.
  function fromAddress(address) {
    const state = parse(new URL(address).hash.slice(1));
    if (inputs.some((input) => nameOf(input) in state)) set(state, standard);
  }

  // A preset is a design: it keeps the input, unless it names one. That of the controls looks pressed.
  const INPUT = ["rms", "seed", "per-point"];
  const kept = (input) => (INPUT.includes(nameOf(input)) ? read(input) : standard(input));
  const ownInput = () => Object.fromEntries(INPUT.map((name) => [name, read(find(name))]));
  let before; // the input before a preset that names another one: the next preset brings it back
  const presets = [...document.querySelectorAll(".live-presets button")];
  function markPreset() {
    for (const button of presets) {
      const goal = parse(button.dataset.live);
      const same = (input) => Number(read(input)) === Number(goal[nameOf(input)] ?? kept(input));
      button.setAttribute("aria-pressed", inputs.every(same));
    }
  }

  const listeners = []; // of other panels: they are called with the settings and what was computed
  const settings = () => ({
    rms: value("rms"),
    seed: value("seed"),
    diameter: value("diameter"),
    shifts: [value("shift-a") * Math.PI, value("shift-b") * Math.PI],
    photons: photons(),
    iterations: value("iterations"),
    both: find("both").checked,
    accelerated: find("accelerated").checked,
    likelihood: find("likelihood").checked,
  });

  function columns(made, { both, accelerated, likelihood }) {
    const iteration = accelerated ? ["accelerated", "accelerated"] : ["shifted", "phase-shifted"];
    const last = likelihood ? ["likelihood", "maximum likelihood"] : iteration;
    const linear = ["linear", both ? "linear (both)" : "linear"];
    return [linear, ["arcsine", "arcsine"], last].map(([key, name]) => ({ key, name, made: made[key] }));
  }

  const succeeds = (error, rms) => error <= Math.max(TOLERATED * rms, draw.SMALLEST);

  const off = (error, rms) =>
    error > NO_USE ? "is hardly better than random" : `is off by ${Math.round((100 * error) / rms)} %`;

  // The result in one sentence, for everybody.
  function sentence(made, set) {
    const parts = columns(made, set).map(({ name, made: one }) => {
      if (!one) return `${name}: no unique solution`;
      const error = one.errors.at(-1);
      const found = succeeds(error, set.rms) ? "recovers the phase" : off(error, set.rms);
      return `${name} ${found} (${draw.error(error)} rad)`;
    });
    return `Input ${set.rms.toFixed(2)} rad rms, Strehl ratio ${made.strehl.toFixed(2)}. Errors: ${parts.join(", ")}.`;
  }

  // A phase that has nothing to do with the input: without its piston, the principal value.
  function centred(phase) {
    const sum = (part) => live.inside.reduce((total, k) => total + part(phase[k]), 0);
    const piston = Math.atan2(sum(Math.sin), sum(Math.cos));
    return phase.map((value) => Math.atan2(Math.sin(value - piston), Math.cos(value - piston)));
  }

  // The phase of a method with the piston of the input: on the branch of the input where they agree, else the principal
  // value.
  function found(input, residual, lost) {
    const phase = input.map((value, k) => value + residual[k]);
    if (lost) return centred(phase);
    for (const k of live.inside)
      if (Math.abs(residual[k]) > AGREE) phase[k] -= 2 * Math.PI * Math.round(phase[k] / (2 * Math.PI));
    return phase;
  }

  function show(made, set) {
    draw.scale(set.rms);
    draw.phase("phase", made.phase);
    draw.focal("focal", made.focal, set.diameter);
    draw.image("image-a", made.frames[0]);
    draw.image("image-b", made.frames[1]);
    columns(made, set).forEach(({ name, made: one }, place) => {
      const error = one?.errors.at(-1);
      draw.phase(`found-${place}`, one && found(made.phase, one.residual, error > NO_USE));
      draw.difference(`error-${place}`, one?.residual);
      const good = one && succeeds(error, set.rms);
      const verdict = find(`verdict-${place}`);
      verdict.textContent = one ? `${good ? "✓" : "✗"} ${draw.error(error)} rad` : "✗ ambiguous";
      verdict.className = `live-verdict ${good ? "live-good" : "live-bad"}`;
      for (const title of ["name", "error-name"])
        find(`${title}-${place}`).textContent = name.replace("maximum", "max."); // the column is narrow
    });
    const { linear, arcsine, shifted, accelerated, likelihood } = made;
    draw.curves({ linear, arcsine, shifted, accelerated, likelihood });
    find("says").textContent = sentence(made, set);
    listeners.forEach((listener) => listener(set, made));
  }

  // Names of the pictures and the announcement, for screen readers, once the sliders rest.
  function describe(made, set) {
    find("phase").setAttribute("aria-label", `Input phase, ${set.rms.toFixed(2)} radian rms`);
    find("focal").setAttribute("aria-label", `Focal plane, dimple of ${set.diameter.toFixed(2)} lambda over D`);
    ["a", "b"].forEach((letter, m) => {
      const brightest = made.frames[m].reduce((a, b) => Math.max(a, b));
      find(`image-${letter}`).setAttribute("aria-label", `Image ${m + 1}, brightest ${brightest.toFixed(2)}`);
    });
    columns(made, set).forEach(({ name, made: one }, place) => {
      const error = one ? `error ${draw.error(one.errors.at(-1))} radian rms` : "no unique solution";
      find(`found-${place}`).setAttribute("aria-label", `Phase of the ${name} method, ${error}`);
      find(`error-${place}`).setAttribute("aria-label", `Map of the error of the ${name} method, ${error}`);
    });
    find("curve").setAttribute("aria-label", `Error after each of ${set.iterations} iterations`);
    find("announced").textContent = `${sentence(made, set)} ${set.iterations} iterations.`;
  }

  let rest;
  let follow;
  function update() {
    const set = settings();
    const start = performance.now();
    const made = live.compute(set);
    find("time").textContent = `Computed in ${(performance.now() - start).toFixed(0)} ms.`;
    show(made, set);
    markPreset();
    clearTimeout(rest);
    rest = setTimeout(() => describe(made, set), PAUSE);
    follow ??= setTimeout(() => {
      follow = undefined;
      toAddress();
    }, FOLLOW);
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

  let playing = null;
  function play(on) {
    clearInterval(playing);
    playing = null;
    find("play").textContent = on ? "■ Stop" : "▶ Play";
    if (!on) return;
    const last = value("iterations") || Number(find("iterations").defaultValue);
    set({ iterations: "0" });
    playing = setInterval(() => {
      const next = value("iterations") + 1;
      set({ iterations: String(next) });
      if (next >= last) play(false);
    }, TURN);
  }

  for (const input of inputs) {
    input.addEventListener("input", () => {
      play(false);
      if (INPUT.includes(nameOf(input))) before = undefined;
      caption(input);
      ask();
    });
    caption(input);
  }
  find("play").addEventListener("click", () => play(!playing));
  find("reset").addEventListener("click", () => {
    play(false);
    before = undefined;
    find("tried").textContent = "";
    set({}, standard);
  });
  const tries = [...document.querySelectorAll("button[data-live]")].filter((button) => !button.closest("#live"));
  const next = find("next");
  const offer = (place) => {
    const button = tries[place % tries.length];
    next.textContent = `${place < tries.length ? "Next" : "Again"}: ${button.textContent}`;
    next.onclick = () => button.click();
  };
  offer(0);
  for (const button of document.querySelectorAll("button[data-live]")) {
    button.addEventListener("click", () => {
      play(false);
      const preset = button.closest("#live");
      const goal = parse(button.dataset.live);
      if (preset) {
        const input = before ?? ownInput();
        set({ ...input, ...goal }, standard);
        before = INPUT.some((name) => name in goal) ? input : undefined;
        find("tried").textContent = "";
        return;
      }
      set(goal, standard);
      before = undefined;
      const [name, whole] = [button.textContent, button.parentElement.textContent.trim()];
      const said = whole.replace(/ \(\d+\)/g, ""); // an equation's number would be no link here
      find("tried").textContent = `${name}: ${said.slice(name.length).trim()}`;
      offer(tries.indexOf(button) + 1);
      document.getElementById("live").scrollIntoView();
      if ("play" in button.dataset) play(true);
    });
  }
  addEventListener("hashchange", (event) => {
    fromAddress(event.newURL);
    if (changed().length) toAddress(); // a link to a heading has replaced the settings
  });

  new MutationObserver(() => {
    draw.bars();
    ask();
  }).observe(document.documentElement, { attributeFilter: ["data-theme"] });

  // Another panel changes the sensor: the comment of the tour no longer fits.
  function change(changes) {
    play(false);
    find("tried").textContent = "";
    set(changes);
  }

  live.page = { set: change, settings, listen: (listener) => listeners.push(listener) };
  draw.bars();
  fromAddress(location.href);
  update();
})();
