//! Uploaded inputs: listed and deleted.

use super::{Client, Error};
use crate::domain::InputName;
use crate::rpc::proto;

/// One page of uploaded inputs.
#[derive(Debug)]
pub struct InputPage {
    /// As the server tells of them.
    pub inputs: Vec<proto::Input>,
    /// Empty on the last page.
    pub next_page_token: String,
}

impl Client {
    /// One page of the tenant's uploaded inputs, the newest first.
    ///
    /// # Errors
    /// See [`Error`].
    pub async fn list_inputs(&mut self, page_size: u16, page_token: &str) -> Result<InputPage, Error> {
        let request = proto::ListInputsRequest {
            parent: self.parent(),
            page_size: page_size.into(),
            page_token: page_token.to_owned(),
        };
        let page = self.call(request, |mut client, request| async move { client.inputs.list_inputs(request).await });
        let page = page.await?;
        Ok(InputPage { inputs: page.inputs, next_page_token: page.next_page_token })
    }

    /// Deletes an uploaded input; jobs that were created with it keep it.
    ///
    /// # Errors
    /// See [`Error`].
    pub async fn delete_input(&mut self, name: &InputName) -> Result<(), Error> {
        let request = proto::DeleteInputRequest { name: name.to_string() };
        self.call(request, |mut client, request| async move { client.inputs.delete_input(request).await }).await
    }
}
