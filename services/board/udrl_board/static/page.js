// What every script of the page needs: its elements, numbers as people read them, lists of facts.
export const $ = (id) => document.getElementById(id);

// Numbers below ten with three digits, others with one after the point; or with as many there as are wanted.
export const number = (x, digits) =>
  x == null
    ? "–"
    : x.toLocaleString("en", digits === undefined && Math.abs(x) < 10 ? { maximumSignificantDigits: 3 } : { maximumFractionDigits: digits ?? 1 });

// Numbers of an axis in the largest unit that fits, with as many digits as tell them apart.
export function labels(values) {
  const most = Math.max(...values.map(Math.abs));
  const [unit, suffix] = most >= 1e6 ? [1e6, "M"] : most >= 1e4 ? [1e3, "K"] : [1, ""];
  const whole = (x, digits) => Math.abs(x * 10 ** digits - Math.round(x * 10 ** digits)) < 1e-6;
  const digits = [0, 1, 2, 3].find((d) => values.every((v) => whole(v / unit, d))) ?? 4;
  return values.map((v) => (v === 0 ? "0" : `${(v / unit).toFixed(digits)}${suffix}`));
}

// The least of 1, 2, 5, 10, 20, ... times a power of ten that is not less.
export function nice(x) {
  const power = 10 ** Math.floor(Math.log10(x));
  return [1, 2, 5, 10].map((m) => m * power).find((s) => s >= x * (1 - 1e-9));
}

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
