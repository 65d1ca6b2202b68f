// A search lists the chapters before the API pages.
var Scorer = {
  score: ([page, , , , score]) => (page.startsWith("book/api") ? score - 100 : score),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};

// The excerpts show prose, not code or lists of contents. `Search` is defined after this file, in the same script.
queueMicrotask(() => {
  const all = Search.htmlToText;
  Search.htmlToText = (html, anchor) => {
    const page = new DOMParser().parseFromString(html, "text/html");
    const unread = ".highlight, .onlyprint, details.hide, button, form, nav, svg, .live, .math";
    for (const part of page.querySelectorAll(unread)) part.remove();
    return all(page.documentElement.outerHTML, anchor);
  };
});
