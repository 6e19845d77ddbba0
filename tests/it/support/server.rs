//! A server to test against.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use scpsfm::client::{self, Client};
use scpsfm::engine::{self, Engine, Solver};
use scpsfm::rpc::convert::result::encode as encode_result;
use scpsfm::rpc::proto::calibration_service_client::CalibrationServiceClient;
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::server::{Options, Server};
use scpsfm::store::sqlite::Sqlite;
use tempfile::TempDir;
use tonic::transport::Channel;

/// Nothing in these tests takes nearly so long; what does hangs.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// A running server on a free port of the loopback interface.
pub struct TestServer {
    pub server: Server,
    pub engine: Engine,
    directory: TempDir,
}

impl TestServer {
    /// One worker, defaults otherwise.
    pub async fn start(solver: Solver) -> Self {
        Self::start_with(solver, Options::default(), one_worker()).await
    }

    pub async fn start_with(solver: Solver, options: Options, engine: engine::Options) -> Self {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let (server, engine) = serve(directory.path(), solver, options, engine).await;
        Self { server, engine, directory }
    }

    /// Goes down as on SIGTERM, and comes up again with the same store and the same port.
    pub async fn restart(self, solver: Solver) -> Self {
        let Self { server, engine, directory } = self;
        let listen = server.address();
        engine.drain(Duration::ZERO).await;
        server.shutdown(PATIENCE).await.expect("a clean shutdown");
        drop(engine);
        let options = Options { listen, ..Options::default() };
        let (server, engine) = serve(directory.path(), solver, options, one_worker()).await;
        Self { server, engine, directory }
    }

    /// Where the store is.
    pub fn directory(&self) -> &Path {
        self.directory.path()
    }

    pub fn url(&self) -> String {
        format!("http://{}", self.server.address())
    }

    pub async fn channel(&self) -> Channel {
        Channel::from_shared(self.url()).expect("a URL").connect().await.expect("a connection")
    }

    pub async fn jobs(&self) -> JobServiceClient<Channel> {
        JobServiceClient::new(self.channel().await)
    }

    pub async fn calibration(&self) -> CalibrationServiceClient<Channel> {
        CalibrationServiceClient::new(self.channel().await)
    }

    pub async fn client(&self) -> Client {
        Client::connect(&self.url(), &client::Options::default()).await.expect("a connection")
    }
}

pub fn one_worker() -> engine::Options {
    engine::Options { workers: 1, ..engine::Options::default() }
}

async fn serve(directory: &Path, solver: Solver, options: Options, engine: engine::Options) -> (Server, Engine) {
    let store = Sqlite::open(directory).expect("a store");
    let engine = Engine::start(engine, Arc::new(store), solver, encode_result).await.expect("an engine");
    let server = Server::bind(options, engine.clone()).await.expect("a server");
    (server, engine)
}

/// Fails the test when `future` does not end.
pub async fn soon<T>(future: impl Future<Output = T>) -> T {
    tokio::time::timeout(PATIENCE, future).await.expect("this should have ended long ago")
}
