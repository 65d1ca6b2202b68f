// The form of a notebook's parameters (run/NAME.js): fields in, changed values out, as JSON text by name.
"use strict";

(() => {
  const SLIDER = 10; // largest range of a number that gets a slider
  const STEPS = 200; // of a slider
  const FIRST = 6; // parameters that show at once

  // Make an element; a handler is a function, and true sets an attribute without a value.
  function make(tag, attributes = {}, ...content) {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) {
      if (typeof value === "function") element.addEventListener(name, value);
      else if (value !== false && value !== undefined) element.setAttribute(name, value === true ? "" : value);
    }
    element.append(...content);
    return element;
  }

  // A number as JSON that keeps its type in Python: 1000.0, not 1000, for 1e3.
  function numberText(text) {
    const trimmed = text.trim();
    try {
      JSON.parse(trimmed);
      return trimmed;
    } catch {
      const number = Number(trimmed);
      return trimmed && Number.isFinite(number) ? String(number) : JSON.stringify(trimmed);
    }
  }

  const short = (value) => (typeof value === "number" && !Number.isInteger(value) ? String(Number(value.toPrecision(6))) : String(value));
  const isList = (limits) => limits.list !== undefined;
  const isText = (limits) => !isList(limits) && limits.low === undefined && !limits.choices && !limits.yes;

  // How a value stands in a field, and what JSON the text of a field means.
  function shown(value, limits) {
    if (value === null || value === undefined) return "";
    if (!isList(limits) || !Array.isArray(value)) return short(value);
    return limits.list.list ? JSON.stringify(value) : value.map((one) => shown(one, limits.list)).join(", ");
  }

  function meant(text, limits) {
    if (isList(limits)) {
      if (limits.list.list) return text.trim() || "[]";
      const parts = text.split(",").map((part) => part.trim());
      return `[${parts.filter(Boolean).map((part) => meant(part, limits.list)).join(", ")}]`;
    }
    if (limits.yes) return text;
    return limits.low === undefined ? JSON.stringify(text) : numberText(text);
  }

  const range = ({ low, high }) => (low === undefined ? "" : `${short(low)} to ${short(high)}`);

  const greek = (text) => text.replaceAll("lambda", "λ").replaceAll("-theta", "−θ").replaceAll("theta", "θ");

  // Open the folds around an element.
  function unfold(element) {
    for (let fold = element.closest("details"); fold; fold = fold.parentElement.closest("details")) fold.open = true;
  }

  // A field: its label, its control, and the text that counts as unchanged.
  class Field {
    constructor(form, path, { meaning, unit, default: standard, limits }, optional = false) {
      this.limits = limits;
      this.standard = optional ? "" : shown(standard, limits);
      const id = `run-${path}`;
      const common = { id, name: path, autocomplete: "off", "aria-describedby": `${id}-about` };
      if (limits.choices) {
        const choices = limits.choices.map((one) => make("option", { value: one }, one));
        this.control = make("select", common, ...(optional ? [make("option", { value: "" }, `${standard}`)] : []), ...choices);
      } else if (limits.yes) {
        this.control = make("select", common, ...["false", "true"].map((one) => make("option", { value: one }, one)));
      } else {
        const number = limits.low !== undefined;
        const step = limits.whole ? 1 : "any";
        this.control = make("input", {
          ...common,
          type: number ? "number" : "text",
          ...(number ? { min: limits.low, max: limits.high, step } : { spellcheck: "false" }),
          required: !optional && (number || limits.empty === false),
          placeholder: optional ? shown(standard, limits) : undefined,
        });
      }
      this.write(this.standard);
      const name = path.split(".").pop();
      // A meaning that begins with *of* or *per* continues the name: *seed* of all random screens.
      const noun = /^(of|per) /.test(meaning) ? `${name.replace(/^n_/, "").replaceAll("_", " ")} ` : "";
      const words = greek([noun + meaning, unit].filter(Boolean).join(", "));
      const about = [words && make("code", {}, name), range(isList(limits) ? limits.list : limits)].filter(Boolean);
      this.element = make("div", { class: "run-field" },
        make("label", { for: id }, words || name),
        this.control,
        make("small", { id: `${id}-about` }, ...about.flatMap((one, index) => (index ? [": ", one] : [one]))));
      if (limits.low !== undefined && !limits.whole && !optional && limits.high - limits.low <= SLIDER) this.addSlider(path);
      else if (isText(isList(limits) ? limits.list : limits) && /files?$/.test(path)) this.addFiles(form, path);
    }

    addSlider(path) {
      const { low, high } = this.limits;
      const step = (high - low) / STEPS;
      const slider = make("input", { type: "range", min: low, max: high, step, "aria-label": `${path}, slider`, tabindex: "-1" });
      slider.value = this.control.value;
      slider.addEventListener("input", () => {
        this.control.value = short(Math.min(high, Math.max(low, Number(slider.value))));
        this.control.dispatchEvent(new Event("input", { bubbles: true }));
      });
      this.slider = slider;
      this.control.addEventListener("input", () => (slider.value = this.control.value));
      this.control.after(slider);
    }

    // Files of the reader: they stay on this computer.
    addFiles(form, path) {
      const pick = make("input", { type: "file", multiple: isList(this.limits), "aria-label": `${path}, from this computer` });
      pick.addEventListener("change", () => {
        for (const file of pick.files) form.files.set(file.name, file);
        this.write([...pick.files].map((file) => file.name).join(", "));
        this.control.dispatchEvent(new Event("input", { bubbles: true }));
      });
      this.control.after(pick);
    }

    get text() {
      return this.control.value;
    }

    get changed() {
      return this.text !== this.standard;
    }

    get json() {
      return meant(this.text, this.limits);
    }

    write(text) {
      this.control.value = text;
      if (this.slider) this.slider.value = text;
    }

    put(value) {
      this.write(shown(value, this.limits));
    }
  }

  // A mapping such as the pupil: its kind, and the fields of that kind, empty for the default.
  class Mapping {
    constructor(form, path, parameter) {
      const { kinds, fields } = parameter.limits;
      this.kinds = kinds;
      this.standard = parameter.default;
      const names = Object.keys(kinds);
      if (names.length) {
        const limits = { choices: names };
        this.kind = new Field(form, `${path}.kind`, { meaning: "kind", unit: "", default: parameter.default.kind ?? names[0], limits });
        this.kind.control.addEventListener("input", () => this.show());
      }
      const made = Object.entries(fields).map(([name, one]) => [name, new Field(form, `${path}.${name}`, one, true)]);
      this.fields = Object.fromEntries(made);
      this.common = Object.keys(fields).filter((name) => !Object.values(kinds).some((of) => of.includes(name)));
      const all = [...(this.kind ? [this.kind] : []), ...Object.values(this.fields)];
      const legend = make("summary", {}, `${path}: ${parameter.meaning}`);
      this.element = make("details", { class: "run-mapping" }, legend, ...all.map((field) => field.element));
      this.put(this.standard);
    }

    show() {
      const known = this.kind ? this.kinds[this.kind.text] : [];
      for (const [name, field] of Object.entries(this.fields))
        field.element.hidden = !known.includes(name) && !this.common.includes(name);
    }

    put(value) {
      if (this.kind) this.kind.put(value.kind ?? this.kind.standard);
      for (const [name, field] of Object.entries(this.fields)) field.put(value[name]);
      this.show();
      this.first ??= this.json;
    }

    get changed() {
      return this.json !== this.first;
    }

    get json() {
      const parts = this.kind ? [`"kind": ${this.kind.json}`] : [];
      for (const [name, field] of Object.entries(this.fields))
        if (field.text !== "" && !field.element.hidden) parts.push(`${JSON.stringify(name)}: ${field.json}`);
      return `{${parts.join(", ")}}`;
    }
  }

  // YAML for the command line: words without quotation marks.
  function yaml(json) {
    return json.replace(/"((?:[^"\\]|\\.)*)"/g, (quoted, word) =>
      /^[A-Za-z_][\w.:]*\w$/.test(word) && !/^(true|false|null|yes|no|on|off)$/i.test(word) ? word : quoted);
  }

  class Form {
    constructor(notebook) {
      this.notebook = notebook;
      this.files = new Map(); // of the reader, by name
      this.fields = Object.fromEntries(Object.entries(notebook.parameters).map(([name, parameter]) =>
        [name, new (parameter.limits.fields ? Mapping : Field)(this, name, parameter)]));
    }

    // The first fields, and the others in a fold.
    get elements() {
      const all = Object.values(this.fields).map((field) => field.element);
      const rest = all.length > FIRST + 2 ? all.splice(FIRST) : [];
      const more = make("details", { class: "run-mapping" }, make("summary", {}, `${rest.length} more parameters`), ...rest);
      return rest.length ? [...all, more] : all;
    }

    // Changed values, as JSON text by name.
    get changed() {
      const changed = Object.entries(this.fields).filter(([, field]) => field.changed);
      return Object.fromEntries(changed.map(([name, field]) => [name, field.json]));
    }

    // Put values, and the defaults of all others.
    put(values) {
      for (const [name, field] of Object.entries(this.fields))
        field.put(values[name] ?? this.notebook.parameters[name].default);
    }

    get command() {
      const given = Object.entries(this.changed).map(([name, json]) => {
        const text = `${name}=${yaml(json)}`;
        return /[\s{}[\]"'\\$`]/.test(text) ? `-p '${text.replaceAll("'", "\\u0027")}'` : `-p ${text}`;
      });
      const quoted = given.join(" ").replace(/["\\$`]/g, "\\$&");
      return `make rerun FIGURE=${this.notebook.name}${quoted && ` ARGS="${quoted}"`}`;
    }

    // The address holds what is changed, so that a setting can be shared.
    get hash() {
      const text = new URLSearchParams(this.changed).toString();
      return text && `#run:${text}`;
    }

    readAddress() {
      if (!location.hash.startsWith("#run:")) return false;
      const values = {};
      for (const [name, text] of new URLSearchParams(location.hash.slice(5))) {
        try {
          if (name in this.fields) values[name] = JSON.parse(text);
        } catch {
          // A damaged address changes nothing.
        }
      }
      this.put(values);
      for (const field of Object.values(this.fields)) if (field.changed) unfold(field.element);
      return true;
    }
  }

  window.zwfsForm = { Form, make, unfold };
})();
