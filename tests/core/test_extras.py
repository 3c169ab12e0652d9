"""Optional packages: one error names the feature, the package and the command that installs it."""

import importlib

import pytest

from r5dgs_core import extras
from r5dgs_core.errors import BackendError


def test_a_missing_package_is_named_with_its_command():
    with pytest.raises(BackendError) as error, extras.required("models", "encoders", "or do without"):
        importlib.import_module("no_such_package")
    assert str(error.value) == (
        "models: cannot import no_such_package; remedy: pip install 'r5dgs[encoders]'; or do without"
    )
    assert isinstance(error.value.__cause__, ImportError)


def test_other_errors_are_reported_only_on_demand():
    with pytest.raises(RuntimeError), extras.required("models", "encoders"):
        raise RuntimeError("built for another torch")
    required = extras.required("models", "encoders", also=(RuntimeError,))
    with pytest.raises(BackendError, match="built for another torch"), required:
        raise RuntimeError("built for another torch")


def test_an_installed_package_is_imported():
    with extras.required("models", "encoders"):
        import json
    assert json.loads("1") == 1
