// Comparison of runs: their evaluations in one chart, and a table to switch between them.
import { Chart, merge } from "./charts.js";
import { evaluated, number } from "./format.js";
import { $, legend, made, setText } from "./page.js";
import { STATES } from "./run.js";

const EVERY_MS = 5000;
const COLOURS = ["evaluation", "explored", "commanded", "good", "bad", "text"];
// Lines of further runs repeat the colours with dashes.
const dash = (k) => (k < COLOURS.length ? undefined : [6, 2 + 2 * Math.floor(k / COLOURS.length)]);

// The run that this page shows, among those of the board.
export const shown = new URLSearchParams(location.search).get("number") ?? "0";

const nameOf = ({ place, status }) => place.run_dir.split("/").filter(Boolean).at(-1) ?? status?.run_id ?? "unknown";

function showTable(runs) {
  $("run-table").tBodies[0].replaceChildren(
    ...runs.map((run, k) => {
      const row = made("tr"), { status } = run, link = made("a", { href: `?number=${k}`, textContent: nameOf(run) });
      row.insertCell().append(String(k) === shown ? made("strong", { textContent: nameOf(run) }) : link);
      const values = status ? [status.environment, STATES[status.state], number(status.env_steps), evaluated(status.final_evaluation ?? status.evaluation)] : ["–", "unknown", "–", "–"];
      for (const value of values) row.insertCell().textContent = value;
      return row;
    }),
  );
}

function showChart(chart, runs) {
  const made = runs.map(({ status, evaluations }) => (status?.final_evaluation ? [...evaluations, status.final_evaluation] : evaluations));
  const { xs, column } = merge(...made.map((all, k) => [all, "env_steps", { [k]: (e) => e.mean }]));
  legend($("all-legend"), runs.map((run, k) => [nameOf(run), "line", COLOURS[k % COLOURS.length], dash(k)]));
  chart.show(xs, runs.map((_, k) => column(k)), "The last point of a run that has ended is its final evaluation.", (i) =>
    runs.map((run, k) => [nameOf(run), made[k].findLast((e) => e.env_steps <= xs[i])]).filter(([, e]) => e)
      .map(([name, e]) => `${name}: ${evaluated(e)} after ${number(e.env_steps)}`).join("; ") + ".");
}

export async function compare() {
  let chart = null;
  for (;;) {
    try {
      const runs = document.hidden && chart ? null : await (await fetch("runs")).json();
      if (runs?.length === 1) return;
      if (runs) {
        $("runs").hidden = false;
        chart ??= new Chart($("all"), $("all-said"), runs.map((_, k) => ({ colour: COLOURS[k % COLOURS.length], width: 2, points: true, dash: dash(k) })));
        showTable(runs);
        showChart(chart, runs);
      }
    } catch (error) {
      if (chart) setText($("all-said"), `The runs cannot be updated (${error.message}).`);
    }
    await new Promise((done) => setTimeout(done, EVERY_MS));
  }
}
