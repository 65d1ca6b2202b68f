// Interactive versions of figures, see book/_ext/explore.py. Bokeh and the data are loaded when a reader asks for them.
{
  const folder = new URL("explore/", document.currentScript.src);
  const dark = () => document.documentElement.dataset.theme === "dark";
  const loaded = {};

  function load(name) {
    loaded[name] ??= new Promise((resolve, reject) => {
      const script = document.createElement("script");
      Object.assign(script, { src: new URL(name, folder), onload: resolve, onerror: () => reject(new Error(name)) });
      document.head.append(script);
    });
    return loaded[name];
  }

  function make(name, properties = {}, ...children) {
    const node = Object.assign(document.createElement(name), properties);
    node.append(...children);
    return node;
  }

  // Three digits that count, as in the tooltips of all curves.
  function short(value) {
    const size = Math.abs(value);
    return value === 0 || (size >= 1e-3 && size < 1e5) ? String(Number(value.toPrecision(4))) : value.toExponential(3);
  }

  function colorOf(entry) {
    return entry[dark() ? "dark" : "light"];
  }

  function tooltip(title, ...values) {
    return `<b>${title}</b>${values.map(([name, value]) => `<br>${name}: ${value}`).join("")}`;
  }

  function addCells(plot, panel, palette) {
    const { width, height, ...columns } = panel.cells;
    const source = new Bokeh.ColumnDataSource({ data: { ...columns, text: columns.value.map(short) } });
    const mapper = new Bokeh.LogColorMapper({ palette, low: 1, high: 10 });
    const cells = plot.rect({
      x: { field: "x" }, y: { field: "y" }, width, height, source,
      fill_color: { field: "value", transform: mapper }, line_color: null,
    });
    cells.hover_glyph = null;
    const tooltips = tooltip("@x{0.0} λ/D, ±@y{0.00}π", ["photons", "@text"]);
    plot.add_tools(new Bokeh.HoverTool({ renderers: [cells], tooltips }));
  }

  // The glyphs of a curve, each with the properties that take its colour.
  function addCurve(plot, panel, curve, entry) {
    const { x, y, low, high } = curve;
    const texts = { x_text: x.map(short), y_text: y.map(short) };
    const source = new Bokeh.ColumnDataSource({ data: { x, y, ...texts, ...(low && { low, high }) } });
    const place = { x: { field: "x" }, y: { field: "y" }, source };
    const parts = [];
    if (low) {
      const ends = { x: { field: "x" }, y1: { field: "low" }, y2: { field: "high" }, source };
      parts.push([plot.varea({ ...ends, fill_alpha: 0.15 }), ["fill_color"]]);
    }
    if (!entry.fill) {
      const line = { line_width: entry.width, line_dash: entry.dash, line_cap: "round" };
      parts.push([plot.line({ ...place, ...line }), ["line_color"]]);
    }
    const alpha = entry.marker ? 1 : 0; // a curve without marks shows its values too
    const size = entry.fill ? 12 : 7;
    const marker = plot.scatter({
      ...place, marker: entry.marker || "circle", size, hit_dilation: 2, fill_alpha: alpha, line_alpha: alpha,
    });
    if (entry.fill) marker.glyph.fill_color = entry.fill;
    parts.push([marker, entry.fill ? ["line_color"] : ["line_color", "fill_color"]]);
    const tooltips = tooltip(entry.name, [panel.x, "@x_text"], [panel.y, "@y_text"]);
    plot.add_tools(new Bokeh.HoverTool({ renderers: [marker], tooltips }));
    for (const [renderer] of parts) renderer.hover_glyph = null; // else the curve changes under the mouse
    return parts;
  }

  function addPanel(panel, drawing, redraws) {
    const kind = (axis) => (panel.log.includes(axis) ? "log" : "linear");
    const plot = Bokeh.Plotting.figure({
      height: 320, sizing_mode: "stretch_width", tools: [], toolbar_location: null, title: panel.title,
      x_axis_type: kind("x"), y_axis_type: kind("y"), x_axis_label: panel.x, y_axis_label: panel.y,
      ...(panel.limits.length && { y_range: panel.limits }),
      background_fill_color: null, border_fill_color: null, outline_line_color: null,
    });
    const zoom = new Bokeh.BoxZoomTool();
    plot.add_tools(zoom);
    plot.toolbar.active_drag = zoom;
    if (panel.cells) addCells(plot, panel, drawing.palette);
    const curves = drawing.legend.map((entry, place) => addCurve(plot, panel, panel.curves[place], entry));
    redraws.push(() => {
      const [ink, grid] = dark() ? ["#e0e0e0", "#444444"] : ["#222222", "#dddddd"];
      for (const axis of [...plot.below, ...plot.left]) {
        axis.setv({ axis_label_text_color: ink, major_label_text_color: ink, axis_line_color: ink,
          major_tick_line_color: ink, minor_tick_line_color: null, axis_label_text_font_style: "normal",
          axis_label_text_font_size: "14px", major_label_text_font_size: "13px" });
      }
      for (const one of plot.center) if (one instanceof Bokeh.Grid) one.grid_line_color = grid;
      plot.title.text_color = ink;
      curves.forEach((parts, place) => {
        for (const [renderer, names] of parts) {
          renderer.visible = drawing.legend[place].shown;
          for (const name of names) renderer.glyph[name] = colorOf(drawing.legend[place]);
        }
      });
    });
    return plot;
  }

  // Show twice the range of each axis.
  function zoomOut(plot) {
    for (const [range, scale] of [[plot.x_range, plot.x_scale], [plot.y_range, plot.y_scale]]) {
      const [to, from] = scale instanceof Bokeh.LogScale ? [Math.log10, (value) => 10 ** value] : [Number, Number];
      const [start, end] = [to(range.start), to(range.end)];
      const more = (end - start) / 2;
      range.setv({ start: from(start - more), end: from(end + more) });
    }
  }

  const MARKS = { circle: "●", square: "■", triangle: "▲", inverted_triangle: "▼", diamond: "◆", star: "★",
    x: "×", cross: "+", plus: "✚" };

  function legendButton(entry, redraw) {
    const sample = make("span", { className: "explore-sample" });
    sample.setAttribute("aria-hidden", "true");
    const dash = entry.dash.join(" ");
    sample.innerHTML = `<svg viewBox="0 0 36 14" width="36" height="14">${
      entry.fill ? "" : `<path d="M0 7H36" stroke-width="${entry.width * 1.3}" stroke-dasharray="${dash}"/>`
    }<text x="18" y="12" text-anchor="middle">${MARKS[entry.marker] ?? ""}</text></svg>`;
    const button = make("button", { type: "button" }, sample, entry.name);
    button.setAttribute("aria-pressed", entry.shown);
    button.addEventListener("click", () => {
      entry.shown = !entry.shown;
      button.setAttribute("aria-pressed", entry.shown);
      redraw();
    });
    return [button, () => { sample.style.color = entry.fill ? "inherit" : colorOf(entry); }];
  }

  function table({ header, rows }) {
    const line = (cells, kind) => make("tr", {}, ...cells.map((text) => make(kind, { textContent: text })));
    const head = make("thead", {}, line(header, "th"));
    const body = make("tbody", {}, ...rows.map((row) => line(row.map((text) => short(Number(text))), "td")));
    const box = make("div", { className: "explore-table", tabIndex: 0 }, make("table", { className: "table" }, head, body));
    box.setAttribute("role", "group");
    box.setAttribute("aria-label", "Values of the figure");
    return make("details", {}, make("summary", { textContent: "Values as a table" }), box);
  }

  async function draw(name, box) {
    await load("bokeh.min.js");
    await load("bokeh-api.min.js");
    await load(`${name}.js`);
    Bokeh.logger.set_level("warn");
    const drawing = window.zwfsExplore[name];
    const redraws = [];
    const redraw = () => redraws.forEach((one) => one());
    const plots = drawing.panels.map((panel) => addPanel(panel, drawing, redraws));
    const legend = make("div", { className: "explore-legend" });
    legend.setAttribute("role", "group");
    legend.setAttribute("aria-label", "Curves");
    for (const [button, recolor] of drawing.legend.map((entry) => legendButton(entry, redraw))) {
      legend.append(button);
      redraws.push(recolor);
    }
    const tools = make("div", { className: "explore-tools" });
    for (const [text, change] of [["Zoom out", zoomOut], ["Reset zoom", (plot) => plot.reset.emit()]]) {
      const button = make("button", { type: "button", textContent: text });
      button.addEventListener("click", () => plots.forEach(change));
      tools.append(button);
    }
    const panels = make("div", { className: "explore-panels" });
    const help = "Point at a mark to see its values. Drag to zoom. Click a name to hide or show its marks.";
    box.replaceChildren(make("p", { textContent: help }), legend, panels, tools, table(drawing.table));
    redraw();
    new MutationObserver(redraw).observe(document.documentElement, { attributeFilter: ["data-theme"] });
    box.views = [];
    for (const plot of plots) {
      const panel = make("div");
      panels.append(panel);
      box.views.push(await Bokeh.Plotting.show(plot, panel));
    }
    box.dataset.drawn = true;
  }

  for (const button of document.querySelectorAll("[data-explore]")) {
    const box = make("div", { className: "explore-box", hidden: true });
    button.parentElement.after(box);
    button.setAttribute("aria-expanded", "false");
    button.addEventListener("click", async () => {
      box.hidden = !box.hidden;
      button.setAttribute("aria-expanded", !box.hidden);
      if (box.childNodes.length) return;
      box.textContent = "Loading …";
      try {
        await draw(button.dataset.explore, box);
      } catch {
        box.textContent = "The interactive version cannot be loaded. The figure and the CSV file show the same values.";
      }
    });
  }
}
