"""Errors that a user can resolve; messages name the place, the expected and the found content, and the remedy."""


class R5dgsError(Exception):
    """Base class of errors that the command line and the extension report without a traceback.

    Attributes:
        code: Code of the fault in the table of `r5dgs check`, "" if it has none.
    """

    def __init__(self, message: str = "", *, code: str = ""):
        super().__init__(message)
        self.code = code


class ConfigError(R5dgsError):
    """A configuration key or value cannot be used."""


class UsageError(ConfigError):
    """Arguments are wrong, independently of any file: an unknown value, or contradictory options."""


class DatasetError(R5dgsError):
    """A data set is incomplete or inconsistent."""


class CheckpointError(R5dgsError):
    """A training run folder or checkpoint cannot be read or continued."""


class SceneFileError(R5dgsError):
    """A `.r5dgs` or PLY file is truncated, foreign or inconsistent."""


class BackendError(R5dgsError):
    """An optional dependency (rasterizer, encoder, Blender) is missing or unusable."""


class TrainingError(R5dgsError):
    """Training cannot continue."""


class Interrupted(R5dgsError):
    """The user or the system requested a stop; finished work is kept, and the message explains how to continue."""
