// Gets updates of the run from the board's server once a second, and shows them.
import { outside, ranges } from "./buffer.js";
import { command, count, number } from "./format.js";
import { Learning } from "./learning.js";
import { $, legend, setText } from "./page.js";
import { Plane } from "./plane.js";
import { commands, showRun } from "./run.js";
import { compare, shown } from "./runs.js";
import { Stage } from "./stage.js";

const EVERY_MS = 1000;
// Longer than the board waits for a replay service that hangs.
const LONGEST_MS = 20_000;

const known = { place: {}, hello: null, status: null, iterations: [], evaluations: [], contents: null, obeyed: null };

const learning = new Learning();
const stage = new Stage();
const buffer = new Plane($("buffer"), { x: "return", y: "length, steps", label: "Returns and lengths of the episodes in the replay buffer", describedBy: "buffer-said" });

function showContents(contents) {
  if (!contents.returns.length) return;
  legend($("buffer-legend"), [
    ["episode, older ones fainter", "dot", "episode"],
    ["outstanding exploratory command", "cross", "explored"],
    ["command of evaluations", "diamond", "chosen"],
  ]);
  const pairs = contents.desired_returns.map((r, i) => [r, contents.desired_horizons[i]]);
  const newest = Math.max(...contents.iterations), oldest = Math.min(...contents.iterations);
  const evaluation = [contents.desired_return, contents.desired_horizon];
  buffer.draw(() => {
    buffer.axes(...ranges(contents));
    contents.returns.forEach((r, i) => {
      const youth = newest > oldest ? (contents.iterations[i] - oldest) / (newest - oldest) : 1;
      buffer.dot(r, contents.lengths[i], { class: "episode", opacity: 0.25 + 0.6 * youth });
    });
    for (const [r, h] of pairs) buffer.mark("cross", r, h, "explored", 4);
    buffer.mark("diamond", ...evaluation, "chosen", 7);
  });
  const held = known.status?.buffer, recent = known.hello?.config.recent_size;
  const best = held ? `The ${number(held.episodes)} best episodes have returns from ${number(held.return_min)} to ${number(held.return_max)}${recent ? `; the newest ${number(recent)} are shown too` : ""}. ` : "";
  setText($("buffer-said"), `${best}Evaluations command ${command(...evaluation)}. ${pairs.length ? count(pairs.length, "exploratory command is", "exploratory commands are") : "No exploratory command is"} outstanding.${outside(contents, buffer)}`);
}

function showObeyed() {
  const { obeyed, status } = known;
  if (!status?.weights_version) return;
  const isOther = obeyed && obeyed.weights_version !== status.weights_version;
  setText($("obeys"), obeyed
    ? obeyed.answer + (isOther ? ` Measured with weights version ${obeyed.weights_version}; the latest is ${status.weights_version}.` : "")
    : `Measure the returns that the agent obtains: ${commands(known).obedience}`);
}

async function update() {
  const after = known.iterations.at(-1)?.iteration ?? -1;
  const run = encodeURIComponent(known.hello?.run_id ?? "");
  const response = await fetch(`news?number=${shown}&after=${after}&run=${run}`, { signal: AbortSignal.timeout(LONGEST_MS) });
  if (!response.ok) throw new Error(await response.text());
  const news = await response.json();
  if (news.hello) Object.assign(known, { hello: news.hello, iterations: [], evaluations: [] });
  known.place = news.place;
  known.iterations.push(...news.iterations);
  known.evaluations.push(...news.evaluations);
  const isOtherState = news.status?.state !== known.status?.state;
  if (news.status) known.status = news.status;
  if (news.status) showRun(known);
  if (news.hello || news.iterations.length || isOtherState) learning.show(known);
  const isMeasured = JSON.stringify(news.obeyed) !== JSON.stringify(known.obeyed);
  known.obeyed = news.obeyed;
  if (news.contents) showContents((known.contents = news.contents));
  if (known.contents && (news.contents || isMeasured)) stage.update(known);
  showObeyed();
  setText($("about"), `udrl ${news.software}`);
  showProblem([news.problem, news.status?.problem, news.status?.advice].filter(Boolean).join(" "));
}

function showProblem(text) {
  $("problem").hidden = !text;
  setText($("problem"), text);
}

async function updateForever() {
  for (;;) {
    try {
      if (!document.hidden) await update();
    } catch (error) {
      showProblem(`The board's server does not reply (${error.message}). Is udrl board still running? Retrying.`);
    }
    await new Promise((done) => setTimeout(done, EVERY_MS));
  }
}

updateForever();
compare();
