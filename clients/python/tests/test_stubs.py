"""The stubs that are checked in are those of the project's proto/."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from google.protobuf import descriptor_pb2

from scpsfm._stubs import (
    admin_service_pb2,
    admin_service_pb2_grpc,
    calibration_service_pb2,
    calibration_service_pb2_grpc,
    input_pb2,
    input_service_pb2,
    input_service_pb2_grpc,
    job_pb2,
    job_service_pb2,
    job_service_pb2_grpc,
    progress_pb2,
    result_pb2,
    settings_pb2,
)

PROTO = Path(__file__).resolve().parents[3] / "proto"
MODULES = {
    module.DESCRIPTOR.name: module
    for module in (
        admin_service_pb2,
        calibration_service_pb2,
        input_pb2,
        input_service_pb2,
        job_pb2,
        job_service_pb2,
        progress_pb2,
        result_pb2,
        settings_pb2,
    )
}
SERVICES = {
    "AdminService": (admin_service_pb2, admin_service_pb2_grpc),
    "CalibrationService": (calibration_service_pb2, calibration_service_pb2_grpc),
    "InputService": (input_service_pb2, input_service_pb2_grpc),
    "JobService": (job_service_pb2, job_service_pb2_grpc),
}


def without_json_names(file: descriptor_pb2.FileDescriptorProto) -> descriptor_pb2.FileDescriptorProto:
    """What protoc adds on request only."""
    open_messages = list(file.message_type)
    while open_messages:
        message = open_messages.pop()
        open_messages.extend(message.nested_type)
        for field in message.field:
            field.ClearField("json_name")
    return file


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> dict[str, descriptor_pb2.FileDescriptorProto]:
    """What protoc makes of proto/ now."""
    if not PROTO.is_dir():
        pytest.skip("proto/ is not there: this is no checkout")
    out = tmp_path_factory.mktemp("proto") / "set.bin"
    files = sorted((PROTO / "scpsfm" / "v1").glob("*.proto"))
    command = [sys.executable, "-m", "grpc_tools.protoc", f"-I{PROTO}", f"--descriptor_set_out={out}"]
    subprocess.run([*command, *map(str, files)], check=True)
    found = descriptor_pb2.FileDescriptorSet.FromString(out.read_bytes())
    return {file.name: without_json_names(file) for file in found.file}


def test_every_file_has_its_stubs_and_they_say_the_same(
    compiled: dict[str, descriptor_pb2.FileDescriptorProto],
) -> None:
    assert set(compiled) == set(MODULES), "run tools/generate_stubs.py"
    for name, module in MODULES.items():
        checked_in = descriptor_pb2.FileDescriptorProto.FromString(module.DESCRIPTOR.serialized_pb)
        assert without_json_names(checked_in) == compiled[name], f"{name}: run tools/generate_stubs.py"


def test_a_field_that_is_missing_would_be_found(compiled: dict[str, descriptor_pb2.FileDescriptorProto]) -> None:
    changed = descriptor_pb2.FileDescriptorProto()
    changed.CopyFrom(compiled["scpsfm/v1/input.proto"])
    next(message for message in changed.message_type if message.name == "View").field[0].name = "title"
    checked_in = descriptor_pb2.FileDescriptorProto.FromString(input_pb2.DESCRIPTOR.serialized_pb)
    assert without_json_names(checked_in) != changed


@pytest.mark.parametrize("service", SERVICES)
def test_every_call_has_its_stub(service: str) -> None:
    messages, grpc_module = SERVICES[service]
    declared = {method.name for method in messages.DESCRIPTOR.services_by_name[service].methods}
    servicer = getattr(grpc_module, f"{service}Servicer")
    assert declared == {name for name in vars(servicer) if not name.startswith("_")}


@pytest.mark.parametrize("module", MODULES.values(), ids=MODULES)
def test_stubs_ask_for_no_newer_protobuf_than_the_package(module: ModuleType) -> None:
    assert module.__file__ is not None
    # Code of protoc from 26 on refuses every runtime that is older than itself.
    assert "ValidateProtobufRuntimeVersion" not in Path(module.__file__).read_text(encoding="utf-8")


def test_nothing_global_is_named_as_the_proto_packages_are() -> None:
    program = (
        "import sys, scpsfm\n"
        "assert 'scpsfm.v1' not in sys.modules, 'a module scpsfm.v1'\n"
        "assert 'google.api.field_behavior_pb2' in sys.modules\n"
        "from google.api import annotations_pb2, resource_pb2, client_pb2\n"
        "from google.rpc import error_details_pb2\n"
        "from scpsfm._stubs import job_service_pb2 as j\n"
        "from google.api import field_behavior_pb2 as b\n"
        "options = j.GetJobRequest.DESCRIPTOR.fields_by_name['name'].GetOptions()\n"
        "assert list(options.Extensions[b.field_behavior]) == [b.REQUIRED]\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
