// What every script of the page needs: its elements, numbers as people read them, lists of facts.
export const $ = (id) => document.getElementById(id);

export const number = (x, digits = 1) => (x == null ? "–" : x.toLocaleString("en", { maximumFractionDigits: digits }));

export function facts(list, entries) {
  list.replaceChildren(
    ...entries.map(([name, value]) => {
      const pair = document.createElement("div"), term = document.createElement("dt"), said = document.createElement("dd");
      term.textContent = name;
      said.textContent = value;
      pair.append(term, said);
      return pair;
    }),
  );
}
