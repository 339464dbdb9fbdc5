"""Settings that fit an environment, chosen by what random episodes in it show.

What suits an environment depends on how long its episodes are and how large its returns. Settings
that are left open (``auto``, :data:`OPEN`) are chosen when a run is created, from random episodes
that are played for it. A :class:`udrl.config.Config` holds the choice.
"""

import math
from collections.abc import Collection, Sequence
from hashlib import blake2b

import msgspec

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.commands import Command, CommandSampler
from udrl.config import OPEN, Config, change
from udrl.episode import Episode

#: Random episodes that are looked at: so many, and as many again until there are enough env steps.
_EPISODES, _MOST_EPISODES, _STEPS = 20, 500, 1_000
#: Steps for which a random action may be held, episodes that are played with each, and how many of
#: the best count.
_HOLDS, _TRIED, _COUNT = (2, 8, 32), 40, 3
#: What the network reads well.
_LEAST, _MOST = 0.1, 10.0
#: Env steps in an iteration: if its episodes are like random ones, and at most.
_USUAL_STEPS, _MOST_STEPS = 2_000, 5_000
#: Fewest episodes of an iteration, and of the warm-up.
_FEWEST_EPISODES, _FEWEST_WARM_UP = 10, 50
#: Best episodes that commands are drawn from, as a share of an iteration.
_BEST = 0.3
#: Iterations that each half of the replay buffer holds.
_HALF = 6


def fit(
    config: Config,
    left_open: Collection[str],
    generator: EpisodeGenerator,
    episodes: Sequence[Episode] | None = None,
) -> Config:
    """Return the settings of a new run, with those chosen that were left open.

    Args:
        config: the settings; the values of open ones count for nothing.
        left_open: names of open ones, among :data:`udrl.config.OPEN`.
        generator: plays the first commands of the warm-up, if anything is open.
        episodes: to look at instead.

    Raises:
        ConfigError: the settings do not go with what was chosen.
        EnvironmentFault: the environment failed three times under the same command.
    """
    assert OPEN.keys() >= set(left_open)
    if not left_open:
        return config
    hold = config.commands.warm_up_hold
    if episodes is None:
        commands = CommandSampler(
            change(config, n_warm_up_episodes=_MOST_EPISODES), generator.spec
        ).warm_up()
        if not {"warm_up_hold", "hold_steps"}.isdisjoint(left_open):
            hold = _best_hold(generator, commands)
        episodes = _play(generator, commands, hold)
    returns = [e.episode_return for e in episodes]
    reach = max(*map(abs, returns), max(returns) - min(returns), 0.0)
    length = sum(e.length for e in episodes) / len(episodes)
    n_episodes = config.commands.n_episodes_per_iter
    if "n_episodes_per_iter" in left_open:
        longest = generator.spec.max_episode_steps
        wanted = math.ceil(min(_USUAL_STEPS / length, _MOST_STEPS / longest))
        n_episodes = max(wanted, _FEWEST_EPISODES)
    by_chance = chance(episodes)
    baseline = "action_value" if by_chance else "value"
    if config.training.segments == "all":
        baseline = "none"  # no other goes with them
    chosen = {
        "return_scale": _rounded(1 / reach) if reach else 1.0,
        # How long an episode lasts is luck too, and one that is asked to be short would gamble.
        "horizon_scale": 0.0 if by_chance else _rounded(1 / length),
        "baseline": baseline,
        "n_warm_up_episodes": max(n_episodes, _FEWEST_WARM_UP),
        "warm_up_hold": hold,
        "hold_steps": hold,
        "n_episodes_per_iter": n_episodes,
        "last_few": max(1, round(_BEST * n_episodes)),
        "replay_size": _HALF * n_episodes,
        "recent_size": _HALF * n_episodes,
    }
    return change(config, **{name: chosen[name] for name in left_open})


def _held(commands: Sequence[Command], hold: int) -> list[Command]:
    return [msgspec.structs.replace(c, random_hold=hold) for c in commands]


def _best_hold(generator: EpisodeGenerator, commands: Sequence[Command]) -> int:
    """Return for how many steps random actions should be held.

    Where one step moves little, actions that change at every step cancel each other, and no random
    episode obtains more than the usual. Only there they are held: for as many steps as let the best
    few of some episodes obtain most, and all of these few more than the usual. If in doubt, 1.
    """

    def returns(hold: int) -> list[float]:
        tried = generate_episodes(generator, _held(commands[:_TRIED], hold), None)
        return sorted(e.episode_return for e in tried)

    without = returns(1)
    usual = without[_TRIED // 2]
    if without[-1] > usual:
        return 1
    found = {hold: returns(hold)[-_COUNT:] for hold in _HOLDS}
    found = {hold: few for hold, few in found.items() if few[0] > usual}
    return max(found, key=lambda hold: sum(found[hold]), default=1)


def _play(generator: EpisodeGenerator, commands: Sequence[Command], hold: int) -> list[Episode]:
    """Return random episodes: some, and as many again until there are enough env steps."""
    episodes = list[Episode]()
    while len(episodes) < len(commands) and sum(e.length for e in episodes) < _STEPS:
        some = commands[len(episodes) :][:_EPISODES]
        episodes += generate_episodes(generator, _held(some, hold), None)
    return episodes


def chance(episodes: Sequence[Episode]) -> bool:
    """Say whether the same action after the same observation had different consequences.

    By chance, or by what is not observed: an agent cannot tell. Where no observation comes twice,
    nothing can be said, and the answer is no.
    """
    seen: dict[bytes, bytes] = {}
    for episode in episodes:
        steps = [
            blake2b(o.tobytes(), digest_size=16).digest() + a.tobytes()
            for o, a in zip(episode.observations, episode.actions, strict=True)
        ]
        follows = [o.tobytes() for o in episode.rewards]
        for t, step in enumerate(steps):
            last = t + 1 == episode.length
            if last and episode.truncated:
                continue  # what would have followed is not kept
            after = follows[t] + (b"" if last else steps[t + 1][:16])
            if seen.setdefault(step, after) != after:
                return True
    return False


def fits(scale: float, size: float) -> bool:
    """Say whether a scale makes a number that a network reads well of what is usual."""
    return 0.0 in (size, scale) or _LEAST <= scale * size <= _MOST


def _rounded(scale: float) -> float:
    """Return a scale that is possible, with two digits."""
    possible = min(max(scale, 1e-6), 1e6)
    return float(f"{possible:.2g}")
