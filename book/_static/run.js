// Python in the page: runs the cells of the notebook with the reader's parameters, and the examples of the text.
// Nothing is loaded before the reader asks. run-worker.js is the worker, run-form.js the form.
"use strict";

(() => {
  const { Form, make, unfold } = window.zwfsForm;
  const settings = window.zwfsPython; // run/settings.js
  const notebook = window.zwfsNotebook; // run/NAME.js, on the page of a notebook
  const folder = new URL(".", document.currentScript.src); // _static
  const article = document.querySelector("article");
  const onDisk = location.protocol === "file:";
  const place = new URL(settings.place, new URL("..", folder)).href;
  const KINDS = { "csv": "text/csv", "screens.csv": "text/csv", "png": "image/png", "pdf": "application/pdf", "svg": "image/svg+xml" };
  const START = 0.2; // share of a run before which it says no time left
  class Stopped extends Error {}

  const loadScript = (name) => new Promise((done, failed) => {
    const script = make("script", { src: new URL(name, folder).href });
    script.onload = done;
    script.onerror = () => failed(new Error(`${name} is missing: build the book again`));
    document.head.append(script);
  });

  // The one Python of the page.
  const python = {
    worker: null,
    busy: false,
    waiting: new Map(),
    onProgress: () => {},

    async start() {
      if (this.worker) return;
      if (!window.zwfsFiles) await loadScript("run/files.js");
      const source = new Blob([`(${zwfsWorker})()`], { type: "text/javascript" });
      const address = URL.createObjectURL(source);
      this.worker = new Worker(address);
      this.worker.onmessage = ({ data }) => this.hear(data);
      try {
        const { digests, packages } = settings;
        const extra = notebook?.extra ?? [];
        this.versions = await this.call("load", { place, digests, packages, extra, files: window.zwfsFiles });
      } catch (error) {
        this.stop(error);
        throw error;
      } finally {
        URL.revokeObjectURL(address);
      }
    },

    hear({ id, value, error, progress }) {
      if (progress) {
        this.onProgress(progress);
        return;
      }
      const [done, failed] = this.waiting.get(id);
      this.waiting.delete(id);
      if (error === undefined) done(value);
      else failed(new Error(error));
    },

    call(call, given = {}) {
      return new Promise((done, failed) => {
        const id = (this.last = (this.last ?? 0) + 1);
        this.waiting.set(id, [done, failed]);
        this.worker.postMessage({ id, call, given });
      });
    },

    stop(reason = new Stopped()) {
      this.worker?.terminate();
      this.worker = null;
      for (const [, failed] of this.waiting.values()) failed(reason);
      this.waiting.clear();
    },
  };

  // Why Python cannot run here, if so.
  function obstacle() {
    if (typeof WebAssembly !== "object" || typeof Worker !== "function")
      return "This browser has no WebAssembly: Python cannot run in the page.";
    if (onDisk && place.startsWith("file:"))
      return "Python cannot run in a page from the disk. Serve the book: python -m http.server --directory FOLDER_OF_THE_BOOK";
    return "";
  }

  const source = onDisk || new URL(place).origin !== location.origin ? ` from ${new URL(place).host}` : "";
  const COST = `The first run loads Python, ${settings.megabytes} MB${source}. Everything is computed on your computer.`;
  const SLOW = " A phone needs about 1 GB of free memory, and several times as long as a computer.";
  const PHONE = matchMedia("(max-width: 600px)");
  const cost = () => COST + (PHONE.matches ? SLOW : "");

  // Numbers as the book writes them, see book/_ext/finish.py.
  const DIGITS = Object.fromEntries([..."-0123456789"].map((digit, k) => [digit, "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"[k]]));
  function written(text) {
    return text
      .replace(/(?<![\w.])(-?\d(?:\.\d+)?)e([+-])0*(\d+)\b/g, (_, factor, sign, exponent) => {
        const ten = `10${[...sign.replace("+", ""), ...exponent].map((digit) => DIGITS[digit]).join("")}`;
        return factor === "1" ? ten : `${factor}·${ten}`;
      })
      .replace(/(?<![\w.)-])-(?=\d)/g, "−")
      .replace(/(?<=\d) ?%/g, "\u00a0%");
  }

  // Both versions stand in the page; an attribute of the article says which of them is seen. With other parameters
  // than those of the book, its results are grey until those of the reader replace them (run.css).
  let altered = false; // whether the parameters of the last run differ from those of the book
  const show = (which) => {
    article.dataset.run = which;
    document.documentElement.dataset.run = which === "yours" && altered ? "changed" : "";
    for (const button of document.querySelectorAll(".run-switch")) button.setAttribute("aria-pressed", String(which === "book"));
  };

  function beside(book, yours) {
    book.parentElement.querySelectorAll(":scope > .run-yours").forEach((old) => old.remove());
    book.classList.add("run-book");
    yours.classList.add("run-yours");
    book.after(yours);
  }

  // Sentences and tables that a cell shows.
  function putOutput(number, { html }) {
    const output = article.querySelector(`.tag_run-${number} .cell_output`);
    if (!output || !html) return;
    if (!output.querySelector(":scope > .run-whole")) output.replaceChildren(make("div", { class: "run-whole" }, ...output.childNodes));
    const yours = make("div", {});
    yours.innerHTML = html; // of Markdown, without any HTML of its own: see driver.py
    for (const table of yours.querySelectorAll("table")) {
      table.classList.add("table");
      const frame = make("div", { class: "pst-scrollable-table-container" });
      table.replaceWith(frame);
      frame.append(table);
    }
    const texts = document.createTreeWalker(yours, NodeFilter.SHOW_TEXT);
    while (texts.nextNode()) {
      const text = texts.currentNode;
      if (!text.parentElement.closest("code, .math")) text.data = written(text.data);
    }
    beside(output.querySelector(":scope > .run-whole"), yours);
  }

  // The page of a notebook: the form, the run and its results.
  class Runner {
    constructor(place) {
      this.first = place.dataset.figure;
      this.form = new Form(notebook);
      this.next = 0; // cell
      this.count = 0; // of runs
      this.later = []; // what is drawn after a run
      this.build(place);
      if (this.form.readAddress()) this.details.open = true;
      this.form.element.addEventListener("input", () => this.changed());
      this.form.element.addEventListener("invalid", (event) => unfold(event.target), true);
      this.changed();
      for (const other of article.querySelectorAll(".run-figure"))
        other.append(make("button", { type: "button", click: () => this.run(other.dataset.figure) }, "Compute this figure again, too"));
    }

    build(place) {
      const button = (text, click, more = {}) => make("button", { type: "button", click, ...more }, text);
      const problem = obstacle();
      this.start = make("button", { type: "submit", disabled: Boolean(problem) }, "Run");
      this.stop = button("Stop", () => python.stop(), { hidden: true });
      this.rest = button("Compute the rest of the page", () => this.go(Infinity), { hidden: true });
      const quick = Object.keys(notebook.quick).length > 0;
      const presets = [
        ...(quick ? [button("Quick values", () => this.preset(notebook.quick))] : []),
        button("Values of the book", () => this.preset({})),
      ];
      this.command = make("code");
      const copy = button("Copy", () => navigator.clipboard.writeText(this.command.textContent));
      this.status = make("p", { role: "status", "aria-live": "polite" }, problem || cost());
      this.bar = make("progress", { hidden: true, "aria-label": "Progress of the run" });
      this.files = make("p", { class: "run-files" });
      this.form.element = make("form", { submit: (event) => { event.preventDefault(); this.run(this.first); } },
        make("div", { class: "run-buttons" }, this.start, this.stop, this.rest, ...presets),
        this.bar, this.status, this.files,
        make("div", { class: "run-fields" }, ...this.form.elements),
        make("p", { class: "run-command" }, "The same from a clone: ", this.command, " ", copy));
      this.details = make("details", { class: "run-details" },
        make("summary", {}, "Change the parameters and run it here"), this.form.element);
      place.replaceChildren(this.details);
    }

    preset(values) {
      this.form.put(values);
      this.changed();
      if (!Object.keys(this.form.changed).length) show("book");
    }

    changed() {
      this.command.textContent = this.form.command;
      const hash = this.form.hash;
      if (hash || location.hash.startsWith("#run:"))
        history.replaceState(null, "", hash || location.pathname + location.search);
      this.rest.hidden = true;
    }

    async run(figure) {
      if (python.busy) return;
      this.details.open = true;
      if (!this.form.element.reportValidity()) return;
      this.next = 0;
      this.count += 1;
      this.later = [];
      this.values = this.form.changed;
      await this.go(notebook.figures[figure] ?? Infinity);
    }

    // Run the cells up to one, and show what they give.
    async go(last) {
      if (python.busy) return;
      python.busy = true;
      this.start.disabled = true;
      this.stop.hidden = this.bar.hidden = false;
      this.bar.removeAttribute("value");
      this.rest.hidden = true;
      this.status.classList.remove("run-error");
      this.began = performance.now();
      try {
        await this.begin();
        await this.cells(last);
      } catch (error) {
        this.next = 0;
        const stopped = error instanceof Stopped;
        this.status.textContent = stopped ? "Stopped. The next run loads Python again." : error.message;
        this.status.classList.toggle("run-error", !stopped);
      } finally {
        python.busy = this.start.disabled = false;
        this.stop.hidden = this.bar.hidden = true;
      }
      for (const task of this.later.splice(0)) await task().catch(() => {}); // stopped: the files so far remain
    }

    async begin() {
      if (this.next) return;
      this.status.textContent = "Loading Python …";
      await python.start();
      this.status.textContent = "Checking the parameters …";
      for (const [name, file] of this.form.files) await python.call("put", { name, bytes: await file.arrayBuffer() });
      const cells = notebook.notebook.cells;
      const defaults = cells.find((cell) => cell.metadata.tags?.includes("parameters")).source;
      const given = { notebook: notebook.name, defaults, given: JSON.stringify(this.values) };
      const refused = await python.call("begin", given);
      if (refused) throw new Error(refused);
      article.querySelectorAll(".run-yours").forEach((old) => old.remove());
      article.querySelectorAll(".run-book").forEach((book) => book.classList.remove("run-book"));
      altered = Object.keys(this.values).length > 0;
      show("yours");
    }

    async cells(last) {
      const cells = notebook.notebook.cells;
      const all = cells.map((_, number) => number).filter((number) => this.runs(cells[number]) && number <= last);
      const rest = all.filter((number) => number >= this.next);
      const tell = this.meter(rest);
      for (const number of rest) {
        tell(`Cell ${all.indexOf(number) + 1} of ${all.length}`, number);
        const shown = await python.call("cell", { source: cells[number].source });
        if (shown.error) throw new Error(shown.error);
        putOutput(number, shown);
        for (const [figure, at] of Object.entries(notebook.figures)) if (at === number) await this.putFigure(figure);
        this.next = number + 1;
      }
      const seconds = Math.round((performance.now() - this.began) / 1000);
      this.rest.hidden = !cells.slice(this.next).some((cell) => this.runs(cell));
      this.status.textContent = `Done in ${seconds} s.`;
    }

    runs(cell) {
      const tags = cell.metadata.tags ?? [];
      return cell.cell_type === "code" && !tags.includes("parameters");
    }

    // Tell the progress through cells. How their time divides among the sweeps was measured with the values of the book
    // and with the quick ones (environment/shares.py); the time so far says how fast it is here.
    meter(numbers) {
      const same = ([name, value]) => name in this.values && JSON.stringify(JSON.parse(this.values[name])) === JSON.stringify(value);
      const quick = Object.entries(notebook.quick);
      const seconds = notebook.shares[quick.filter(same).length > quick.length / 2 ? "quick" : "book"];
      const sum = (parts) => parts.reduce((before, part) => before + part, 0);
      const whole = sum(numbers.flatMap((number) => seconds[number] ?? []));
      const began = performance.now();
      const tell = (text, done) => {
        const left = Math.ceil((performance.now() - began) * (whole / done - 1) / 1000);
        this.status.textContent = `${text}${done > START * whole ? `, about ${left} s left` : " …"}`;
        this.bar.value = done / (whole || 1);
      };
      return (label, number) => {
        const parts = seconds[number] ?? [];
        const before = sum(numbers.filter((one) => one < number).flatMap((one) => seconds[one] ?? []));
        let sweep = 0;
        tell(label, before);
        python.onProgress = ({ done, total }) => {
          tell(`${label}, task ${done} of ${total}`, before + sum(parts.slice(0, sweep)) + (parts[sweep] ?? 0) * (done / total));
          if (done === total) sweep += 1;
        };
      };
    }

    // Put a figure in place of the published one. The picture that is seen now is drawn first; all other files
    // follow while the reader looks at it.
    async putFigure(figure) {
      const kinds = await python.call("kinds", { figure });
      const dark = document.documentElement.dataset.theme === "dark";
      const first = [PHONE.matches ? `narrow${dark ? "-dark" : ""}.png` : "", dark ? "dark.png" : "png"].find((kind) => kinds.includes(kind));
      const picture = await this.draw(figure, first);
      const slots = this.showFigure(figure, picture, kinds);
      const links = {};
      const own = new Blob([JSON.stringify(this.copy(), null, 1)], { type: "application/x-ipynb+json" });
      const whole = make("a", { href: URL.createObjectURL(own), download: `${notebook.name}.ipynb` }, "notebook with these parameters");
      this.files.replaceChildren(`Your ${figure}: `, whole);
      const run = this.count;
      this.later.push(async () => {
        for (const kind of [first, ...kinds.filter((one) => one !== first)]) {
          if (this.count !== run) return;
          const address = kind === first ? picture : await this.draw(figure, kind);
          const [element, attribute] = slots[kind] ?? [];
          element?.setAttribute(attribute, address);
          if (kind in KINDS) links[kind] = make("a", { href: address, download: `${figure}.${kind}`.replace(".screens.", "_screens.") }, kind.toUpperCase());
          this.files.replaceChildren(`Your ${figure}: `, ...Object.values(links).flatMap((link) => [link, " · "]), whole);
        }
      });
    }

    async draw(figure, kind) {
      const bytes = await python.call("draw", { figure, kind });
      return URL.createObjectURL(new Blob([bytes], { type: KINDS[kind.split(".").pop()] }));
    }

    // Show a picture with its mark, and the switch; return the places of the other pictures, by kind.
    showFigure(figure, picture, kinds) {
      const place = article.querySelector(`figure.variants-${CSS.escape(figure)} .wide-figure`);
      if (!place) return {};
      const alt = altered ? "Figure of this run; the CSV file has its numbers." : place.querySelector("img").alt;
      const slots = {};
      const pictures = ["", "dark"].map((mode) => {
        const image = make("img", { src: picture, alt });
        const source = make("source", { media: PHONE.media, srcset: picture });
        slots[mode ? "dark.png" : "png"] = [image, "src"];
        slots[mode ? "narrow-dark.png" : "narrow.png"] = [source, "srcset"];
        return make("picture", { class: mode ? "only-dark" : "only-light" }, ...(kinds.includes("narrow.png") ? [source] : []), image);
      });
      const changed = Object.entries(this.values).map(([name, json]) => `${name} = ${json}`).join(", ");
      const label = make("p", { class: "run-mark" }, changed ? `Your parameters: ${changed}` : "Computed here, with the parameters of the book");
      beside(place, make("div", {}, label, make("div", { class: "wide-figure" }, make("div", {}, ...pictures))));
      place.closest("figure").classList.toggle("narrow", kinds.includes("narrow.png"));
      if (!place.parentElement.querySelector(".run-switch"))
        place.before(make("button", { type: "button", class: "run-switch", "aria-pressed": "false",
          click: () => show(article.dataset.run === "book" ? "yours" : "book") }, "Compare with the figure of the book"));
      return slots;
    }

    // The notebook with these parameters, as papermill would write it, and what it was run with.
    copy() {
      const { cells, metadata, ...rest } = notebook.notebook;
      const at = cells.findIndex((cell) => cell.metadata.tags?.includes("parameters"));
      const python_ = (json) => json.replace(/"(?:[^"\\]|\\.)*"|\b(true|false)\b/g, (all, word) => (word ? word[0].toUpperCase() + word.slice(1) : all));
      const source = Object.entries(this.values).map(([name, json]) => `${name} = ${python_(json)}`).join("\n");
      const added = { cell_type: "code", id: "injected-parameters", metadata: { tags: ["injected-parameters"] }, source, outputs: [], execution_count: null };
      const made = { parameters: this.values, versions: python.versions, command: this.form.command };
      return { ...rest, metadata: { ...metadata, zwfs: made }, cells: [...cells.slice(0, at + 1), ...(source ? [added] : []), ...cells.slice(at + 1)] };
    }
  }

  // An example of the text: it can be run and edited in place. Some need another one, which runs first.
  function addExample(block) {
    const code = block.querySelector("pre");
    const text = code.textContent;
    const edit = make("textarea", { hidden: true, spellcheck: "false", "aria-label": "Code of the example" });
    const said = make("pre", { class: "run-said", role: "status", hidden: true });
    const problem = obstacle();
    const start = make("button", { type: "button", disabled: Boolean(problem), title: problem || cost(), click: () => run() }, "Run");
    const stop = make("button", { type: "button", hidden: true, click: () => python.stop() }, "Stop");
    const change = make("button", { type: "button", click: () => {
      edit.hidden = !edit.hidden;
      block.hidden = !edit.hidden;
      change.textContent = edit.hidden ? "Edit" : "Original";
      edit.value = text.trimEnd();
      edit.rows = edit.value.split("\n").length + 1;
      if (!edit.hidden) edit.focus();
    } }, "Edit");
    block.after(edit, make("div", { class: "run-buttons run-example" }, start, stop, change), said);
    block.source = () => (edit.hidden ? text : edit.value);

    async function run() {
      if (python.busy) return;
      python.busy = start.disabled = true;
      stop.hidden = said.hidden = false;
      said.textContent = python.worker ? "Running …" : `Loading Python, ${settings.megabytes} MB${source} …`;
      said.classList.remove("run-error");
      try {
        await python.start();
        said.textContent = "Running …";
        const before = block.matches(".needs-set-up") ? `${document.querySelector(".set-up").source()}\n` : "";
        const shown = await python.call("example", { source: before + block.source() });
        said.textContent = shown.text + (shown.error ?? "") || "Done. The code prints nothing.";
        said.classList.toggle("run-error", Boolean(shown.error));
      } catch (error) {
        said.textContent = error instanceof Stopped ? "Stopped." : error.message;
        said.classList.toggle("run-error", !(error instanceof Stopped));
      } finally {
        python.busy = start.disabled = false;
        stop.hidden = true;
      }
    }
  }

  const formPlace = document.querySelector(".run-form");
  if (formPlace && notebook) new Runner(formPlace);
  document.querySelectorAll(".runnable").forEach(addExample);
})();
