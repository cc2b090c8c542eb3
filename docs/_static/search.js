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
    // An entry of the index that is the query itself has 100 and stays first; `named` has scored what is like it.
    if (kind === "index") return score;
    const folders = {"how-to": 12, tutorials: 12, explanation: 6, reference: -4, measurements: -10, decisions: -30};
    const places = {changelog: -30, gallery: -10, policies: -5};
    return score + (folders[page.split("/")[0]] ?? places[page] ?? 0);
  },
};

// Sphinx defines `Search` below, in the same file, and asks it when the page is ready.
queueMicrotask(() => {
  const STOP = new Set("a an and are at can do does for from get has how i in is it me my of on or the to use what when where which why with".split(" "));
  const split = text => text.toLowerCase().split(/[^\p{L}\d]+/u).filter(word => word && !STOP.has(word));
  const alike = (a, b) => a === b || (Math.min(a.length, b.length) > 3 && (a.startsWith(b) || b.startsWith(a)));

  // Pages whose title and entries of the index hold the words of the query, in any order and with other endings. A word
  // counts by how few pages have it; one that no page has does not count. A page that has most of them comes before text.
  const named = query => {
    const {docnames, filenames, titles, indexentries} = Search._index, asked = split(query);
    const guide = number => /^(how-to|tutorials|explanation|reference|policies|which_tool)/.test(docnames[number]);
    const entries = titles.map((title, number) => guide(number) ? [split(title)] : []);
    for (const [entry, spots] of Object.entries(indexentries))
      for (const [number, , main] of spots) if (main && guide(number)) entries[number].push(split(entry));
    const has = (number, word) => entries[number].some(words => words.some(other => alike(word, other)));
    const pages = docnames.map((_, number) => number).filter(guide);
    const weights = asked.map(word => pages.filter(number => has(number, word)).length)
      .map(count => count && Math.log(1 + pages.length / count));
    const whole = weights.reduce((sum, weight) => sum + weight, 0);
    return pages.map(number => {
      const held = asked.reduce((sum, word, k) => sum + (has(number, word) ? weights[k] : 0), 0) / whole;
      const closest = Math.max(0, ...entries[number].map(words =>
        words.filter(word => asked.some(other => alike(word, other))).length / Math.max(words.length, asked.length)));
      return [held, 45 * held + 15 * closest, number];
    }).filter(([held]) => held > 0.6)
      .map(([, score, k]) => [docnames[k], titles[k], "", null, Math.round(score), filenames[k], SearchResultKind.index]);
  };

  const terms = Search.performTermsSearch;
  Search.performTermsSearch = (searched, excluded) => {
    const query = new URLSearchParams(location.search).get("q") || "";
    return [...terms(searched, excluded), ...named(query)];
  };
});
