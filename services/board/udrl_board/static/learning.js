// Charts of the run's iterations: returns, speed, loss, admitted episodes.
import { Chart, merge, smooth, thin } from "./charts.js";
import { best, count, evaluated, number } from "./format.js";
import { $, legend } from "./page.js";

// Iterations that exploratory returns are averaged over.
const WINDOW = 10;

const steps = (n) => count(n, "env step");

function commanded({ commanded_min: low, commanded_max: high }) {
  if (low == null) return "";
  const [from, to] = [number(low), number(high)];
  return `, commanded ${from === to ? from : `${from} to ${to}`}`;
}

export class Learning {
  constructor() {
    this.curve = new Chart($("curve"), $("curve-said"), [
      { colour: "evaluation", width: 2, points: true },
      { colour: "evaluation", width: 0, quiet: true },
      { colour: "evaluation", width: 0, quiet: true },
      { colour: "explored", pale: true, quiet: true },
      { colour: "explored", width: 2 },
      { colour: "commanded", dash: [4, 4], quiet: true },
      { colour: "commanded", dash: [4, 4], quiet: true },
      { colour: "evaluation", hollow: true },
      { colour: "good", dash: [10, 4], quiet: true },
    ], [[1, 2, "evaluation"], [5, 6, "commanded"]]);
    this.speed = new Chart($("speed"), $("speed-said"), [{ colour: "evaluation" }]);
    this.loss = new Chart($("loss"), $("loss-said"), [{ colour: "evaluation" }]);
    this.admitted = new Chart($("admitted"), $("admitted-said"), [{ colour: "evaluation", counts: true }]);
  }

  show({ iterations, evaluations, status }) {
    if (!iterations.length) return;
    const averages = smooth(iterations.map((r) => r.explored_return), WINDOW);
    const rows = thin(iterations.map((row, i) => ({ ...row, average: averages[i] })));
    this.showReturns(rows, evaluations, status);
    const last = rows.at(-1), xs = rows.map((r) => r.env_steps);
    const pace = rows.map((r, i) => {
      const before = rows[Math.max(0, i - 5)];
      return r.wall_s > before.wall_s ? (r.env_steps - before.env_steps) / (r.wall_s - before.wall_s) : undefined;
    });
    const after = (text, of) => (i) => `After ${steps(of[i].env_steps)}: ${text(i)}.`;
    this.speed.show(xs, [pace], `${number(pace.at(-1), 0)} over the last iterations, evaluations included.`, after((i) => number(pace[i], 0), rows));
    this.loss.show(xs, [rows.map((r) => r.loss ?? undefined)], last.loss == null ? "Nothing is trained yet." : `${number(last.loss, 3)} in the last iteration.`,
      after((i) => number(rows[i].loss, 3), rows));
    const trained = rows.filter((r) => r.iteration > 0); // all warm-up episodes are among the best so far
    this.admitted.show(trained.map((r) => r.env_steps), [trained.map((r) => r.admitted)], `${number(last.admitted)} from the last iteration.`,
      after((i) => number(trained[i].admitted), trained));
  }

  showReturns(rows, evaluations, status) {
    const final = status?.final_evaluation, target = status?.stop_return;
    legend($("curve-legend"), [
      ["evaluation, mean with 95 % interval", "line", "evaluation"],
      ...(final ? [["final evaluation", "dot", "evaluation hollow"]] : []),
      [`exploratory episodes, mean of ${WINDOW} iterations`, "line", "explored"],
      ["exploratory episodes, each iteration", "line", "explored pale"],
      ["commanded returns", "band", "commanded band"],
      ...(target == null ? [] : [[`target: ${number(target)}`, "line", "target"]]),
    ]);
    const { xs, column } = merge(
      [rows, "env_steps", {
        explored: (r) => r.explored_return, average: (r) => r.average,
        most: (r) => r.commanded_max ?? undefined, least: (r) => r.commanded_min ?? undefined,
      }],
      [evaluations, "env_steps", { mean: (e) => e.mean, high: (e) => e.ci95_high, low: (e) => e.ci95_low }],
      [final ? [final] : [], "env_steps", { final: (e) => e.mean }],
    );
    const columns = ["mean", "high", "low", "explored", "average", "most", "least", "final"].map(column);
    columns.push(xs.map(() => target ?? undefined));
    const last = rows.at(-1), highest = best(evaluations, final);
    const explored = (row) => `exploratory episodes ${number(row.average)}${commanded(row)}`;
    const place = (name, e, x) => `${name} ${evaluated(e)}${e.env_steps < x ? ` (after ${number(e.env_steps)})` : ""}`;
    this.curve.show(xs, columns,
      `After ${steps(last.env_steps)}: ${explored(last)}${highest ? `; best evaluation ${evaluated(highest)} after ${number(highest.env_steps)}` : "; no evaluation yet"}.`,
      (i) => {
        const until = (e) => e.env_steps <= xs[i], row = rows.findLast(until), made = evaluations.findLast(until);
        const parts = [
          final && until(final) ? place("final evaluation", final, xs[i]) : "",
          made ? place("evaluation", made, xs[i]) : "",
          row ? explored(row) : "",
        ];
        return `After ${steps(xs[i])}: ${parts.filter(Boolean).join("; ")}.`;
      });
  }
}
