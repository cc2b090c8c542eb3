// Asks the built site's own search: node ask_site.js build/docs < queries; prints the pages of each, best first, as JSON.
"use strict";

const fs = require("fs"), path = require("path"), vm = require("vm");
const scripts = path.join(process.argv[2], "_static");
const read = name => fs.readFileSync(path.join(scripts, name), "utf8");
const location = {search: ""};
const page = {
  console, location, URLSearchParams, queueMicrotask,
  document: {getElementById: () => null},
  localStorage: {setItem: () => {}},
  SPHINX_HIGHLIGHT_ENABLED: false,
  _: text => text,
  _ready: () => {},
};
page.window = page;
vm.createContext(page);
// In the order of search.html.
for (const script of ["searchtools.js", "language_data.js", "../searchindex.js"]) vm.runInContext(read(script), page);
const Search = vm.runInContext("Search", page);

// After the microtask in which docs/_static/search.js extends the search.
setTimeout(() => {
  const queries = fs.readFileSync(0, "utf8").split("\n").filter(Boolean);
  const answers = queries.map(query => {
    location.search = "?q=" + encodeURIComponent(query);
    const [, ...terms] = Search._parseQuery(query);
    return Search._performSearch(query, ...terms).reverse().map(([name]) => name);
  });
  process.stdout.write(JSON.stringify(answers));
});
