"""The exceptions of this project.

::

    UdrlError
    ├── ConfigError              invalid setting, preset or file
    │   └── UnsupportedEnvironment   the environment does not exist or is not supported
    ├── EnvironmentFault         an environment raised an exception or returned an invalid value
    ├── InvalidData              invalid external data
    │   ├── InvalidMessage           a message does not follow the protocol
    │   └── InvalidWeights           tensors with wrong names, shapes, dtypes or values
    ├── PeerError                failed communication with another process
    │   ├── Unreachable              no reply within the deadline
    │   └── Refused                  the request was refused
    ├── StoreError               unusable run directory
    │   ├── RunInUse                 another replay service has locked it
    │   ├── OtherConfiguration       it belongs to a run with other settings
    │   └── DamagedStore             its content is not what was written
    ├── RunFailed                the run cannot continue
    │   └── Deceived                 the run was trained on false episodes of an actor
    └── Interrupted              a wait ended because the process must stop

A message names the value, what was expected, and the remedy. ``exit_code`` is the exit code of a
command (``docs/operations-reference.md``).
"""


class UdrlError(Exception):
    """Base class of all exceptions of this project."""

    exit_code = 1


class ConfigError(UdrlError):
    """A setting, preset or configuration file is invalid."""

    exit_code = 2


class UnsupportedEnvironment(ConfigError):
    """An environment does not exist, or is not supported."""


class EnvironmentFault(UdrlError):
    """An environment raised an exception or returned an invalid value."""

    exit_code = 3


class InvalidData(UdrlError):
    """External data is invalid."""

    exit_code = 5


class InvalidMessage(InvalidData):
    """A message does not follow the protocol."""


class InvalidWeights(InvalidData):
    """Tensors have wrong names, shapes, dtypes or values."""


class PeerError(UdrlError):
    """Communication with another process failed."""

    exit_code = 6


class Unreachable(PeerError):
    """There was no reply within the deadline."""


class Refused(PeerError):
    """The peer refused the request.

    Attributes:
        code: code of the reason in the protocol (``docs/protocol.md``).
    """

    exit_code = 7

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class StoreError(UdrlError):
    """The run directory cannot be used."""

    exit_code = 8


class RunInUse(StoreError):
    """Another replay service has locked the run directory."""


class OtherConfiguration(StoreError):
    """The run directory belongs to a run with other settings."""


class DamagedStore(StoreError):
    """The store's content is not what was written."""


class RunFailed(UdrlError):
    """The run cannot continue."""

    exit_code = 9


class Deceived(RunFailed):
    """The run was trained on false episodes, which an actor delivered."""

    exit_code = 10


class Interrupted(UdrlError):
    """A wait ended because the process must stop."""

    exit_code = 130
