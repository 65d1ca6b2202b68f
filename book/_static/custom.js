// The theme sets its colours late: boxes would grow by their borders, and a dark page would load the light pictures.
if (document.documentElement.dataset.mode === "auto")
  document.documentElement.dataset.theme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";

// Browsers block pages from the file system from reading other files: a search there shows no summaries.
if (location.protocol === "file:") DOCUMENTATION_OPTIONS.SHOW_SEARCH_SUMMARY = false;

// Text with formulas appears once their font is set, so that nothing moves afterwards.
document.documentElement.classList.add("setting");
document.fonts.load('1em "STIX Two Math"').finally(() => document.documentElement.classList.remove("setting"));

// Tables and formulas that are wider than the page scroll: only those are a stop for the Tab key, with a name.
function nameWideBoxes() {
  for (const box of document.querySelectorAll(".pst-scrollable-table-container, .formula")) {
    const wide = box.scrollWidth > box.clientWidth;
    const label = box.matches(".formula") ? "Formula" : "Table";
    for (const [name, value] of Object.entries({ tabindex: "0", role: "group", "aria-label": label })) {
      if (wide) box.setAttribute(name, value);
      else box.removeAttribute(name);
    }
  }
}

// They, wide code and wide figures fade at the right until their end is in sight.
function fadeWideBoxes() {
  for (const box of document.querySelectorAll(".pst-scrollable-table-container, .highlight pre, .wide-figure"))
    box.classList.toggle("more", box.scrollLeft + box.clientWidth < box.scrollWidth - 1);
}

for (const event of ["load", "resize"]) {
  addEventListener(event, nameWideBoxes);
  addEventListener(event, fadeWideBoxes);
}
addEventListener("scroll", fadeWideBoxes, { capture: true, passive: true });

// The arrows in the list of contents have no text: each gets the name of what it unfolds.
addEventListener("DOMContentLoaded", () => {
  for (const arrow of document.querySelectorAll(".bd-links summary"))
    arrow.setAttribute("aria-label", `Pages of: ${arrow.closest("li").querySelector("a").textContent.trim()}`);
});

// Without hover, the first tap on a word of the glossary shows its definition, and the second one opens the glossary.
let tapped;
addEventListener("click", (event) => {
  const word = event.target.closest("a[data-definition]");
  tapped?.classList.remove("tapped");
  if (word && word !== tapped && matchMedia("(hover: none)").matches) {
    event.preventDefault();
    word.classList.add("tapped");
  }
  tapped = word;
});

// On paper a fold is open.
const opened = [];
addEventListener("beforeprint", () => {
  for (const fold of document.querySelectorAll(".bd-article details:not([open])")) {
    fold.open = true;
    opened.push(fold);
  }
});
addEventListener("afterprint", () => {
  for (const fold of opened.splice(0)) fold.open = false;
});
