"""The calls of the API by name, of a sync or an async channel."""

from __future__ import annotations

from typing import Any

from ._stubs import calibration_service_pb2_grpc, input_service_pb2_grpc, job_service_pb2_grpc

__all__ = ["methods"]


def methods(channel: Any) -> dict[str, Any]:
    """What makes each call: `methods(channel)["GetJob"](request)`. No two services have a call of one name."""
    services: tuple[Any, ...] = (
        calibration_service_pb2_grpc.CalibrationServiceStub,
        input_service_pb2_grpc.InputServiceStub,
        job_service_pb2_grpc.JobServiceStub,
    )
    return {name: call for service in services for name, call in vars(service(channel)).items()}
