// How the site's search ranks pages: what to do stands above what was measured, changed and decided.
var Scorer = {
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: {0: 15, 1: 5, 2: -5},
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,

  score: ([page, , , , score, , kind]) => {
    // An entry of the index that is the query itself has 100 and stays first.
    if (kind === "index") return score;
    const folders = {"how-to": 12, tutorials: 12, explanation: 6, reference: -4, measurements: -10, decisions: -30};
    const places = {changelog: -30, gallery: -10, policies: -5};
    const asked = (new URLSearchParams(location.search).get("q") || "").toLowerCase().split(/\W+/);
    const {docnames, indexentries} = Search._index, number = docnames.indexOf(page);
    // Words of the query that the page names in the index, also with another ending.
    const alike = (a, b) => a === b || (Math.min(a.length, b.length) > 3 && (a.startsWith(b) || b.startsWith(a)));
    const named = Object.entries(indexentries).filter(([, spots]) => spots.some(([doc]) => doc === number));
    const words = named.flatMap(([entry]) => entry.split(/\W+/));
    const hits = asked.filter(word => word.length > 2 && words.some(other => alike(word, other))).length;
    return score + (folders[page.split("/")[0]] ?? places[page] ?? 0) + 8 * hits;
  },
};
