"""The package as it is installed, and the likeness of the two clients."""

from __future__ import annotations

import ast
import dataclasses
import graphlib
import inspect
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import scpsfm
from scpsfm._stubs import settings_pb2

HERE = Path(__file__).resolve().parent.parent


def public(kind: type) -> set[str]:
    return {name for name, value in vars(kind).items() if not name.startswith("_") and callable(value)}


def arguments(function: Any) -> list[tuple[str, Any, Any]]:
    found = inspect.signature(function).parameters.values()
    return [(argument.name, argument.kind, argument.default) for argument in found if argument.name != "client"]


@pytest.mark.parametrize(
    ("sync", "other"), [(scpsfm.Client, scpsfm.AsyncClient), (scpsfm.Job, scpsfm.AsyncJob)], ids=["client", "job"]
)
def test_both_clients_have_the_same_names_and_arguments(sync: Any, other: Any) -> None:
    assert public(sync) == public(other)
    for name in [*public(sync), "__init__"]:
        assert arguments(getattr(sync, name)) == arguments(getattr(other, name)), name
    iterators = {"inputs", "jobs", "events", "progress"}
    for name in public(sync) - iterators - {"job"}:
        assert inspect.iscoroutinefunction(getattr(other, name)), name


def test_settings_have_the_fields_of_the_proto() -> None:
    ours = {field.name for field in dataclasses.fields(scpsfm.Settings)}
    assert ours == {field.name for field in settings_pb2.SolveSettings.DESCRIPTOR.fields}
    message = scpsfm.Settings(method="PSFM", backend="Flex", use_daq=False, seed=0, epipolar_depths=True).to_proto()
    assert message == settings_pb2.SolveSettings(method=4, backend=1, use_daq=False, epipolar_depths=True)
    assert message.HasField("use_daq")
    assert not message.HasField("alpha")
    numpys = scpsfm.Settings(seed=np.array(3), alpha=np.float32(0.5), use_daq=np.bool_(True))  # type: ignore[arg-type]
    assert numpys.to_proto() == settings_pb2.SolveSettings(seed=3, alpha=0.5, use_daq=True)


def test_everything_that_is_named_is_there() -> None:
    assert sorted(scpsfm.__all__) == sorted(set(scpsfm.__all__))
    for name in scpsfm.__all__:
        assert getattr(scpsfm, name) is not None
    for name in scpsfm.errors.__all__:
        assert getattr(scpsfm, name) is getattr(scpsfm.errors, name)
        assert name in scpsfm.__all__
    for name in set(scpsfm.errors.__all__) - {"Violation"}:
        assert issubclass(getattr(scpsfm, name), scpsfm.ScpsfmError)


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(HERE).with_suffix("").parts).removesuffix(".__init__")


def imported(path: Path, modules: set[str]) -> set[str]:
    """The modules of the package that a file names after `import`, wherever in it that stands."""
    parents = path.relative_to(HERE).parent.parts
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = [*parents[: len(parents) - node.level + 1], *([node.module] if node.module else [])]
            names = {".".join([*base, alias.name]) for alias in node.names}
            found |= names & modules or {".".join(base)}
    return found


def test_no_modules_import_each_other() -> None:
    paths = [path for path in (HERE / "scpsfm").rglob("*.py") if "_stubs" not in path.parts]
    modules = {module_name(path) for path in paths}
    graph = {module_name(path): imported(path, modules) & modules for path in paths}
    assert len(graph) > 20 and graph["scpsfm.result"] >= {"scpsfm.tracks", "scpsfm.exports"}
    graphlib.TopologicalSorter(graph).prepare()


def test_wheel_and_sdist_have_stubs_and_types_and_the_wheel_works(tmp_path: Path) -> None:
    pytest.importorskip("build")
    pytest.importorskip("hatchling")
    # The wheel is built from the sdist: nothing outside of that is needed.
    subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(tmp_path), str(HERE)], check=True, timeout=300
    )
    (wheel,) = tmp_path.glob("*.whl")
    (sdist,) = tmp_path.glob("*.tar.gz")
    with zipfile.ZipFile(wheel) as archive:
        inside = set(archive.namelist())
        archive.extractall(tmp_path / "wheel")
    modules = {
        str(path.relative_to(HERE)) for path in (HERE / "scpsfm").rglob("*.py*") if "__pycache__" not in str(path)
    }
    assert modules <= inside
    assert {"scpsfm/py.typed", "scpsfm/_stubs/job_service_pb2.py", "scpsfm/_stubs/job_service_pb2.pyi"} <= inside
    assert not [name for name in inside if name.startswith("tests")]
    with tarfile.open(sdist) as source:
        names = {name.partition("/")[2] for name in source.getnames()}
    assert modules <= names
    assert {"pyproject.toml", "README.md", "tests/test_package.py", "examples/notebook.ipynb"} <= names
    program = "import scpsfm; print(scpsfm.__file__, scpsfm.__version__)"
    output = subprocess.run(
        [sys.executable, "-c", program],
        check=True,
        capture_output=True,
        text=True,
        env={"PYTHONPATH": str(tmp_path / "wheel"), "PATH": ""},
        cwd=tmp_path,
    ).stdout
    assert output.split() == [str(tmp_path / "wheel" / "scpsfm" / "__init__.py"), "0.2.0"]
