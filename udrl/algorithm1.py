"""Algorithm 1 in one process and on one page: the reference for the services.

With ``lead = 0``, the distributed system's results are bit-identical to this file's.
"""

from collections.abc import Callable, Collection, Sequence
from contextlib import closing
from dataclasses import dataclass, field

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.automatic_settings import resolve_automatic
from udrl.commands import CommandSampler
from udrl.config import Budget, Config
from udrl.datasets import resolve_dataset
from udrl.digests import Digest, arrays_digest, episode_digest, replay_digest
from udrl.episode import Episode
from udrl.errors import ConfigError
from udrl.evaluation import Evaluation, summarise
from udrl.experience import Experience
from udrl.graph import acting_graph
from udrl.inference import ActingFunction
from udrl.numerics import resolve_arithmetic
from udrl.replay_buffer import Entry, ReplayBuffer
from udrl.schedule import evaluation_due
from udrl.training import TrainingState, exact_arithmetic, train, untrained


@dataclass
class Run:
    """State of a run after an iteration.

    Attributes:
        buffer: the replay buffer.
        state: the state of training.
        experience: the steps of the buffer's episodes.
        iteration: last completed iteration.
        env_steps: steps of warm-up and exploratory episodes.
        evaluations: evaluations by iteration.
        digests: digests of the buffer's episodes, by id.
    """

    buffer: ReplayBuffer
    state: TrainingState
    experience: Experience
    iteration: int = 0
    env_steps: int = 0
    evaluations: dict[int, Evaluation] = field(default_factory=dict)
    digests: dict[int, Digest] = field(default_factory=dict)

    def add(self, episodes: Sequence[Episode]) -> None:
        """Add episodes to the replay buffer (2.3.1), which evicts the worst."""
        self.env_steps += sum(e.length for e in episodes)
        entries = [Entry(e.episode_return, e.command_id, e.length) for e in episodes]
        evicted = {entry.id for entry in self.buffer.admit(entries)}
        for episode_id in evicted & self.experience.ids():
            self.experience.remove(episode_id)
            del self.digests[episode_id]
        for episode in episodes:
            if episode.command_id not in evicted:
                self.experience.add(episode)
                self.digests[episode.command_id] = episode_digest(episode)

    @property
    def weights_sha256(self) -> str:
        """Digest of the behavior function."""
        return arrays_digest(self.state.weights).hex()

    @property
    def replay_sha256(self) -> str:
        """Digest of the replay buffer."""
        return replay_digest(self.digests[entry.id] for entry in self.buffer).hex()


@exact_arithmetic()
def algorithm1(
    config: Config,
    budget: Budget,
    n_environments: int = 16,
    report: Callable[[Run], None] = lambda run: None,
    automatic: Collection[str] = (),
) -> Run:
    """Train with Algorithm 1 until a stopping criterion is met, and return the final state.

    Args:
        config: the run's settings; ``lead`` must be 0.
        budget: stopping criteria.
        n_environments: episodes generated at the same time; affects speed, not the result.
        report: called after every iteration.
        automatic: names of automatic settings (:mod:`udrl.automatic_settings`).

    Raises:
        ConfigError: ``lead`` is not 0, or other settings cannot be used.
        EnvironmentFault: the environment failed three times under the same command.
    """
    if config.lead != 0:
        raise ConfigError(
            f"lead = {config.lead}: expected 0, because Algorithm 1 alternates training and "
            f"acting; set lead = 0"
        )
    config = resolve_arithmetic(resolve_automatic(config, automatic))
    with closing(EpisodeGenerator(config, n_environments)) as generator:
        return _algorithm1(config, budget, generator, report)


def _algorithm1(
    config: Config, budget: Budget, generator: EpisodeGenerator, report: Callable[[Run], None]
) -> Run:
    config, offline = resolve_dataset(config, generator.spec)
    sample = CommandSampler(config, generator.spec)
    graph = acting_graph(config.network, generator.spec)

    # 1: initialise replay buffer with warm-up episodes using random actions (or a dataset)
    run = Run(
        ReplayBuffer(config.buffer),
        untrained(config, generator.spec),  # 2: initialise a behavior function
        Experience(config, generator.spec),
    )
    run.add(offline or generate_episodes(generator, sample.warm_up(), None))
    due = evaluation_due(0, run.env_steps, config.evaluation.eval_every)
    report(run)

    # 3: while stopping criteria is not reached
    stop = run.env_steps >= budget.max_env_steps
    while not stop:
        run.iteration += 1
        # 4: improve the behavior function by training on replay buffer
        train(run.state, run.experience.by_rank([e.id for e in run.buffer]), config)
        # 5: sample exploratory commands based on replay buffer
        exploratory = sample.explore(run.iteration, run.buffer)
        evaluation = sample.evaluate(run.iteration, run.buffer) if due else []
        # 6: generate episodes using Algorithm 2 and add to replay buffer
        before, behavior = run.env_steps, ActingFunction(graph, run.state.weights)
        run.add(generate_episodes(generator, exploratory, behavior))
        # 7-9: if evaluation required, evaluate current agent using Algorithm 2
        if due:
            episodes = generate_episodes(generator, evaluation, behavior)
            run.evaluations[run.iteration] = summarise([e.episode_return for e in episodes])
        due = evaluation_due(before, run.env_steps, config.evaluation.eval_every)
        stop = run.env_steps >= budget.max_env_steps or _reached_stop_return(run, budget)
        report(run)
    return run


def _reached_stop_return(run: Run, budget: Budget) -> bool:
    latest = run.evaluations.get(run.iteration)
    return (
        budget.stop_return is not None and latest is not None and latest.mean >= budget.stop_return
    )
