//! Calls of the administration.

use super::{Client, Error};
use crate::rpc::proto;

impl Client {
    /// The queue of all servers of the store.
    ///
    /// # Errors
    /// See [`Error`].
    pub async fn queue(&mut self) -> Result<proto::Queue, Error> {
        let answer = self.admin.get_queue(proto::GetQueueRequest {}).await;
        Ok(answer.map_err(|status| self.error(status))?.into_inner())
    }

    /// Pauses the queue.
    ///
    /// # Errors
    /// See [`Error`].
    pub async fn pause_queue(&mut self) -> Result<proto::Queue, Error> {
        let answer = self.admin.pause_queue(proto::PauseQueueRequest {}).await;
        Ok(answer.map_err(|status| self.error(status))?.into_inner())
    }

    /// Ends a pause of the queue.
    ///
    /// # Errors
    /// See [`Error`].
    pub async fn resume_queue(&mut self) -> Result<proto::Queue, Error> {
        let answer = self.admin.resume_queue(proto::ResumeQueueRequest {}).await;
        Ok(answer.map_err(|status| self.error(status))?.into_inner())
    }

    /// Has the server that answers drain and end. Returns its name.
    ///
    /// # Errors
    /// See [`Error`].
    pub async fn drain_server(&mut self) -> Result<String, Error> {
        let answer = self.admin.drain_server(proto::DrainServerRequest {}).await;
        Ok(answer.map_err(|status| self.error(status))?.into_inner().worker)
    }
}
