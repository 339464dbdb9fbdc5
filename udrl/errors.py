"""Every error that this project raises on purpose.

::

    UdrlError
    ├── ConfigError              a setting, preset or file that cannot be used
    │   └── UnsupportedEnvironment   an environment we cannot act in
    ├── EnvironmentFault         an environment raised, or returned what it may not
    ├── InvalidData              bytes from outside that are not what they should be
    │   ├── InvalidMessage           a message
    │   └── InvalidWeights           a set of tensors
    ├── PeerError                another process
    │   ├── Unreachable              does not answer
    │   └── Refused                  answered no
    ├── StoreError               the run directory
    │   ├── RunInUse                 another replay service holds it
    │   ├── OtherConfiguration       it belongs to another configuration
    │   └── DamagedStore             its content is not what was written
    ├── RunFailed                the run cannot go on
    │   └── Deceived                 an actor lied, and the run has learned from it
    └── Interrupted              a wait that ended because the process was told to stop

A message names the value, what was expected, and the remedy. ``exit_code`` is what a command ends
with (``docs/operations-reference.md``).
"""


class UdrlError(Exception):
    """Base of all; catch it to catch everything that we raise on purpose."""

    exit_code = 1


class ConfigError(UdrlError):
    """A setting, preset or configuration file that cannot be used."""

    exit_code = 2


class UnsupportedEnvironment(ConfigError):
    """An environment that does not exist or whose spaces are not supported."""


class EnvironmentFault(UdrlError):
    """An environment raised an exception or returned a value it may not return."""

    exit_code = 3


class InvalidData(UdrlError):
    """Bytes from outside that are not what they should be."""

    exit_code = 5


class InvalidMessage(InvalidData):
    """A message that does not follow the protocol."""


class InvalidWeights(InvalidData):
    """Tensors with wrong names, shapes, dtypes or values."""


class PeerError(UdrlError):
    """Another process of the run."""

    exit_code = 6


class Unreachable(PeerError):
    """Nobody answered within the deadline."""


class Refused(PeerError):
    """The peer answered, and the answer is no.

    Attributes:
        code: the protocol's name for the reason (``docs/protocol.md``).
    """

    exit_code = 7

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class StoreError(UdrlError):
    """The run directory."""

    exit_code = 8


class RunInUse(StoreError):
    """Another replay service holds the run directory."""


class OtherConfiguration(StoreError):
    """The run directory belongs to another configuration."""


class DamagedStore(StoreError):
    """The store's content is not what was written."""


class RunFailed(UdrlError):
    """The run cannot go on, whoever works on it."""

    exit_code = 9


class Deceived(RunFailed):
    """An actor lied, and the run has learned from its episodes."""

    exit_code = 10


class Interrupted(UdrlError):
    """A wait ended because the process was told to stop."""

    exit_code = 130
