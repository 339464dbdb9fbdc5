// Numbers, counts and times as text.

// One decimal; two significant digits below one; integers without decimals; no minus before zero.
export function number(x, digits) {
  if (x == null) return "–";
  const isSmall = digits === undefined && Math.abs(x) < 1;
  const decimals = digits ?? (Number.isInteger(x) ? 0 : 1);
  const digitsShown = isSmall ? { maximumSignificantDigits: 2 } : { minimumFractionDigits: decimals, maximumFractionDigits: decimals };
  return x.toLocaleString("en", { ...digitsShown, signDisplay: "negative" });
}

export const count = (n, one, many = `${one}s`) => `${number(n)} ${n === 1 ? one : many}`;

export const command = (desiredReturn, horizon) => `${number(desiredReturn)} in ${count(Math.max(horizon, 1), "step")}`;

// A mean and the half width of its interval, with as many decimals as that has.
export function evaluated(e) {
  if (!e) return "none yet";
  const half = (e.ci95_high - e.ci95_low) / 2;
  const decimals = half ? Math.min(Math.max(1, Math.ceil(-Math.log10(half))), 6) : undefined;
  return `${number(e.mean, decimals)} ± ${number(half, decimals)}`;
}

// The evaluation with the highest mean, the final one included; null: there is none.
export const best = (evaluations, final) =>
  (final ? [...evaluations, final] : evaluations).reduce((b, e) => (b && b.mean >= e.mean ? b : e), null);

export const percent = (share) => `${Math.round(100 * share)} %`;

export function time(s) {
  const whole = Math.round(s), minutes = Math.floor(whole / 60);
  const two = (n) => String(n).padStart(2, "0");
  return minutes >= 60 ? `${Math.floor(minutes / 60)}:${two(minutes % 60)}:${two(whole % 60)}` : `${minutes}:${two(whole % 60)}`;
}

// Numbers of an axis in the largest unit that fits, with enough digits to distinguish them.
export function labels(values) {
  const most = Math.max(...values.map(Math.abs));
  if (most > 0 && most < 1e-3) return values.map((v) => String(Number(v.toPrecision(6))));
  const [unit, suffix] = most >= 1e6 ? [1e6, "M"] : most >= 1e4 ? [1e3, "K"] : [1, ""];
  const whole = (x, digits) => Math.abs(x * 10 ** digits - Math.round(x * 10 ** digits)) < 1e-6;
  const digits = [0, 1, 2, 3].find((d) => values.every((v) => whole(v / unit, d))) ?? 4;
  return values.map((v) => (v === 0 ? "0" : `${(v / unit).toFixed(digits)}${suffix}`));
}

// The smallest of 1, 2, 5, 10, 20, ... times a power of ten that is not less than x.
export function nice(x) {
  const power = 10 ** Math.floor(Math.log10(x));
  return [1, 2, 5, 10].map((m) => m * power).find((s) => s >= x * (1 - 1e-9));
}
