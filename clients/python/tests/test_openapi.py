"""The description of the API over HTTP: valid, and enough for a generator to make a client of."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from openapi_spec_validator import validate

import scpsfm

from . import scene, support


def generate(document: Path, into: Path) -> None:
    """Makes the client `scpsfm_client`; a call that was left out fails the test."""
    command = [sys.executable, "-m", "openapi_python_client", "generate", "--meta", "none", "--fail-on-warning"]
    command += ["--path", str(document), "--output-path", str(into / "scpsfm_client")]
    config = into / "config.yml"
    # The generator knows no protobuf, and would format with a ruff of the path.
    config.write_text("content_type_overrides: {application/x-protobuf: application/octet-stream}\npost_hooks: []\n")
    ended = subprocess.run([*command, "--config", str(config)], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_a_generated_client_solves(
    http_server: support.Server, small: scene.Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    document = tmp_path / "openapi.json"
    with urllib.request.urlopen(f"{http_server.http_url}/openapi.json", timeout=10) as answer:
        document.write_bytes(answer.read())
    validate(json.loads(document.read_text()))
    generate(document, tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    package = importlib.import_module("scpsfm_client")
    models = importlib.import_module("scpsfm_client.models")

    def call(name: str, **arguments: object) -> Any:
        module = importlib.import_module(f"scpsfm_client.api.job_service.job_service_{name}")
        with package.Client(base_url=http_server.http_url, raise_on_unexpected_status=True) as client:
            return module.sync(client=client, tenant="-", **arguments)

    tracks = small.tracks
    body = {
        "trackSet": {
            "trackCount": tracks.track_count,
            "views": [{"size": {"widthPx": scene.WIDTH, "heightPx": scene.HEIGHT}}] * len(tracks.views),
            "viewIndices": tracks.view_index.tolist(),
            "trackIndices": tracks.track_index.tolist(),
            "xs": tracks.x.tolist(),
            "ys": tracks.y.tolist(),
        }
    }
    job = call("create_job", body=models.CreateJobRequest.from_dict(body))
    name = job.name.rpartition("/")[2]
    end = time.monotonic() + support.PATIENCE
    while (job := call("get_job", job=name)).state in ("JOB_STATE_QUEUED", "JOB_STATE_RUNNING"):
        assert time.monotonic() < end
        time.sleep(0.05)
    assert job.state == "JOB_STATE_SUCCEEDED"
    result = call("get_job_result", job=name)
    with scpsfm.Client(http_server.address) as client:
        expected = client.job(job.name).result()
    assert result.grade == f"GRADE_{expected.grade}"
    assert result.calibrations[0].focal_px == pytest.approx(expected.focal_px)
    assert [view.part for view in result.views] == [camera.part for camera in expected.cameras]
    assert [found.name for found in call("list_jobs").jobs] == [job.name]
    refused = call("create_job", body=models.CreateJobRequest())
    assert (refused.error.code, refused.error.status) == (400, "INVALID_ARGUMENT")
