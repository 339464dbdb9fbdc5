// The state of the run: the header, its numbers, the actors and what to do next.
import { best, count, evaluated, number, time } from "./format.js";
import { $, facts, lines, made, setText } from "./page.js";

export const STATES = { running: "Running", finishing: "Final evaluation", ended: "Ended", failed: "Failed", stopped: "Stopped" };

// Shell commands for this run, with its directory and endpoint if the board knows them.
export function commands({ place, status }) {
  const { run_dir, endpoint } = place;
  const keys = endpoint.startsWith("tls/") ? " --keys DIR" : "";
  const word = (text) => (/^[\w./:-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);
  const directory = run_dir ? word(run_dir) : "RUN_DIR";
  return {
    service: (role) => `udrl ${role} --connect ${endpoint ? word(endpoint) : "ENDPOINT"}${keys}`,
    obedience: `udrl obedience ${directory}`,
    resume: (more = "") => `udrl train ${word(status.environment)} --run-dir ${directory} --resume${more}${keys}`,
  };
}

export function showRun(known) {
  const { status, hello } = known;
  setText($("title"), status.environment);
  setText($("run-name"), status.run_id);
  document.title = `${status.environment} · udrl board`;
  // The reason of a failure is in the alert, with the command that helps.
  const cause = status.state === "failed" ? "" : status.ended_because;
  setText($("state"), [STATES[status.state], cause].filter(Boolean).join(": "));
  $("state").className = `state ${status.state}`;
  showProgress(status);
  showScore(status);
  const buffer = status.buffer;
  facts($("facts"), [
    ["best evaluation", evaluated(best(known.evaluations, status.final_evaluation))],
    ["best return in the buffer", number(buffer.return_max)],
    ["mean return of the buffer", number(buffer.return_mean)],
    ...(status.state === "running" || status.state === "finishing" ? [["env steps/s", number(status.env_steps_per_s, 0)]] : []),
    ["actors", number(status.actors.length)],
  ]);
  const { commands: c, episodes: e } = status;
  facts($("internals"), [
    ["seed", String(hello?.config.seed ?? "")],
    ["results", status.exact ? "exact" : "not exact"],
    ["iteration", number(status.iteration)],
    ["weights", `version ${status.weights_version}`],
    ["weights lag", `${count(status.weights_lag, "version")}, ${number(status.weights_lag_s)} s`],
    ["loss", number(status.loss, 3)],
    ["env steps in evaluations", number(status.eval_env_steps)],
    ["commands issued", number(c.issued)],
    ["accepted, cancelled, outstanding", `${number(c.accepted)}, ${number(c.cancelled)}, ${number(c.outstanding)}`],
    ["episodes delivered", number(e.delivered)],
    ["accepted, duplicate, rejected", `${number(e.accepted)}, ${number(e.duplicate)}, ${number(e.rejected)}`],
    ["environment failures", number(status.env_failures)],
  ]);
  showAlerts(known);
  showActors(status);
}

function showProgress({ env_steps, max_env_steps, wall_s, time_left_s, stop_return, state }) {
  Object.assign($("progress"), { max: max_env_steps, value: Math.min(env_steps, max_env_steps) });
  const left = state !== "running" || time_left_s == null ? "" : `, ${stop_return == null ? "about" : "at most"} ${time(time_left_s)} left`;
  setText($("progress-said"), `${number(env_steps)} of ${number(max_env_steps)} env steps in ${time(wall_s)}${left}`);
}

function showScore({ evaluation, final_evaluation, stop_return }) {
  const shown = final_evaluation ?? evaluation;
  $("score").classList.toggle("reached", Boolean(shown && stop_return != null && shown.mean >= stop_return));
  setText($("score-value"), shown ? number(shown.mean) : "");
  const target = stop_return == null ? "" : `, target ${number(stop_return)}`;
  const what = final_evaluation ? "final evaluation" : "last evaluation";
  setText($("score-said"), shown
    ? `mean return ± ${number((shown.ci95_high - shown.ci95_low) / 2)}, ${what} of ${count(shown.episodes, "episode")}${target}`
    : `no evaluation yet${target}`);
}

function showAlerts(known) {
  const { status } = known, { service, resume } = commands(known);
  const limit = status.limit_reached ? ` --${status.limit_reached.replaceAll("_", "-")} MORE` : "";
  const hints = {
    stopped: `No process is running this run. Resume it: ${resume()}`,
    ended: `Continue training: ${resume(limit)}`,
    // A run that learned from a false episode cannot be resumed; its problem says so.
    failed: status.deceived ? "" : `Fix the cause, then resume the run: ${resume()}`,
  };
  const isActive = status.state === "running" || status.state === "finishing";
  const isMissing = status.waiting.some((w) => w.why.includes("no learner is connected"));
  const hint = hints[status.state] ?? "";
  $("next").hidden = !hint;
  setText($("next"), hint);
  lines($("alerts"), [
    ...(isActive && !status.actors.length ? [`No actor is connected. Start one: ${service("actor")}`] : []),
    ...(isMissing ? [`No learner is connected. Start one: ${service("learner")}`] : []),
    ...(status.exact ? [] : [`The results are not exact: ${status.inexact_reason}`]),
  ]);
  lines($("quarantined"), status.quarantined.map((q) => `quarantined: ${q.id}: ${q.why}`));
}

function showActors(status) {
  $("no-actors").hidden = status.actors.length > 0;
  $("actor-table").hidden = status.actors.length === 0;
  $("actor-table").tBodies[0].replaceChildren(
    ...status.actors.map((a) => {
      const row = made("tr");
      for (const value of [a.id, a.host, a.environments, number(a.env_steps_per_s, 0), a.weights_version, a.weights_lag, a.running, a.reruns, a.failures, `${number(a.last_seen_s, 1)} s ago`])
        row.insertCell().textContent = value;
      return row;
    }),
  );
  lines($("waiting"), status.waiting.map((w) => `${w.who} waits for ${w.for}: ${w.why} (${number(w.seconds, 1)} s)`));
}
