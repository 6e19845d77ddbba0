//! Calls of the administration.

use super::{Client, Error};
use crate::rpc::proto;

impl Client {
    /// The queue of all servers of the store.
    ///
    /// # Errors
    /// See [`Error`].
    pub async fn queue(&mut self) -> Result<proto::Queue, Error> {
        self.call(proto::GetQueueRequest {}, |mut client, request| async move { client.admin.get_queue(request).await })
            .await
    }

    /// Pauses the queue.
    ///
    /// # Errors
    /// See [`Error`].
    pub async fn pause_queue(&mut self) -> Result<proto::Queue, Error> {
        self.call(
            proto::PauseQueueRequest {},
            |mut client, request| async move { client.admin.pause_queue(request).await },
        )
        .await
    }

    /// Ends a pause of the queue.
    ///
    /// # Errors
    /// See [`Error`].
    pub async fn resume_queue(&mut self) -> Result<proto::Queue, Error> {
        self.call(proto::ResumeQueueRequest {}, |mut client, request| async move {
            client.admin.resume_queue(request).await
        })
        .await
    }

    /// Has the server that answers drain and end. Returns its name.
    ///
    /// # Errors
    /// See [`Error`].
    pub async fn drain_server(&mut self) -> Result<String, Error> {
        let server = self.call(proto::DrainServerRequest {}, |mut client, request| async move {
            client.admin.drain_server(request).await
        });
        Ok(server.await?.server)
    }
}
