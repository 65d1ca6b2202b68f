// A search lists the chapters before the glossary, the bibliography and the API pages; but a name of the code, such as
// PhaseShifted or zernike_basis, leads to its entry first, and the words of a heading lead to its section.
var Scorer = {
  score([page, title, , , score]) {
    const asked = new URLSearchParams(location.search).get("q") ?? "";
    if (/[a-z][A-Z]|[._]/.test(asked) && title.split(".").pop() === asked.trim().split(".").pop()) return score + 100;
    if (title.split(" > ").pop().toLowerCase() === asked.trim().toLowerCase()) return score + 50;
    if (page.startsWith("book/api")) return score - 100;
    return ["book/glossary", "book/bibliography"].includes(page) ? score / 20 : score;
  },
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 0, // *gain* is a part of *again*
};

// The excerpts show prose, not code or lists of contents; that of an index entry, which is a word, shows its section.
// `Search` is defined after this file, in the same script.
queueMicrotask(() => {
  const all = Search.htmlToText;
  Search.htmlToText = (html, anchor) => {
    const page = new DOMParser().parseFromString(html, "text/html");
    const unread = ".bd-header-article, .highlight, .onlyprint, details.hide, button, form, nav, svg, .live";
    for (const part of page.querySelectorAll(unread)) part.remove();
    for (const formula of page.querySelectorAll(".math")) formula.textContent = "…";
    const section = anchor.startsWith("#index-") && page.querySelector(anchor)?.closest("section");
    return all(page.documentElement.outerHTML, section ? `#${section.id}` : anchor);
  };
});
