//! `InputService`, still to come: an input travels with its job.

use tonic::{Request, Response, Status, Streaming};

use super::{proto, status};

/// The service.
#[derive(Debug, Clone, Copy, Default)]
pub struct Inputs;

#[tonic::async_trait]
impl proto::input_service_server::InputService for Inputs {
    async fn upload_input(
        &self,
        _request: Request<Streaming<proto::UploadInputRequest>>,
    ) -> Result<Response<proto::Input>, Status> {
        Err(status::not_implemented("UploadInput"))
    }

    async fn get_upload_status(
        &self,
        _request: Request<proto::GetUploadStatusRequest>,
    ) -> Result<Response<proto::UploadStatus>, Status> {
        Err(status::not_implemented("GetUploadStatus"))
    }
}
