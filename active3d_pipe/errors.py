"""The errors a user may meet: each is one line that says what, where, what was expected, what to do.

Every class carries the exit code that the command line returns for it (see `docs/commands.md`).
"""


class Active3dError(Exception):
    """Root of every error that active3d raises on purpose."""

    exit_code = 1


class ConfigError(Active3dError, ValueError):
    """A configuration value, key, or command-line argument is wrong."""

    exit_code = 2


class InputError(Active3dError, ValueError):
    """A scene, log, or other file given by the user is missing or malformed."""

    exit_code = 3


class ArtifactError(Active3dError, OSError):
    """A file inside a run folder is missing, damaged, or from another version."""

    exit_code = 3


class NumericalError(Active3dError, ArithmeticError):
    """A stage produced NaN or infinite values; nothing of it was committed."""

    exit_code = 4


class DamageFound(Active3dError):
    """`verify` found artifacts whose bytes are not the ones that were committed."""

    exit_code = 5


class OutputError(Active3dError, OSError):
    """An output folder or file cannot be created."""

    exit_code = 73


class DiskError(Active3dError, OSError):
    """Writing failed (disk full, input/output error)."""

    exit_code = 74


class RunLockedError(Active3dError, RuntimeError):
    """Another process works on the same run folder."""

    exit_code = 75


class AccessError(Active3dError, PermissionError):
    """The operating system refused access to a file or folder."""

    exit_code = 77
