// A search lists the chapters before the glossary, the bibliography and the API pages; but a name of the code, such as
// PhaseShifted or zernike_basis, leads to its entry first, and the words of a heading lead to its section: first if they
// are all of it, and before the text of other pages if they are two words or more of it, in singular or plural.
var Scorer = {
  score([page, title, , , score]) {
    const asked = new URLSearchParams(location.search).get("q") ?? "";
    if (/[a-z][A-Z]|[._]/.test(asked) && title.split(".").pop() === asked.trim().split(".").pop()) return score + 100;
    const heading = title.split(" > ").pop().toLowerCase();
    if (heading === asked.trim().toLowerCase()) return score + 50;
    if (page.startsWith("book/api")) return score - 100;
    if (["book/glossary", "book/bibliography"].includes(page)) return score / 20;
    const words = (text) => (text.toLowerCase().match(/\p{L}{3,}/gu) ?? []).map((word) => word.replace(/s$/, ""));
    const [sought, found] = [words(asked), words(heading)];
    return sought.length > 1 && sought.every((word) => found.includes(word)) ? score + 30 : score;
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
    const unread = ".bd-header-article, .highlight, .onlyprint, details.hide, button, form, nav, noscript, svg, .live";
    for (const part of page.querySelectorAll(unread)) part.remove();
    for (const formula of page.querySelectorAll(".math")) formula.textContent = "…";
    const section = anchor.startsWith("#index-") && page.querySelector(anchor)?.closest("section");
    return all(page.documentElement.outerHTML, section ? `#${section.id}` : anchor);
  };
});
