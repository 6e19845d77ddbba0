//! HTTP/2 that no client would speak: the server bears it, and serves others meanwhile.

use scpsfm::rpc::proto;
use scpsfm::rpc::proto::calibration_service_client::CalibrationServiceClient;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::support::live::is_served;
use crate::support::memory::peak_mb;
use crate::support::program::Serving;
use crate::support::server::soon;

/// What a client says first (RFC 9113, section 3.4).
const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

/// Frame types and flags (RFC 9113, section 6).
const DATA: u8 = 0;
const HEADERS: u8 = 1;
const RST_STREAM: u8 = 3;
const SETTINGS: u8 = 4;
const PING: u8 = 6;
const CONTINUATION: u8 = 9;
const END_STREAM: u8 = 1;
const END_HEADERS: u8 = 4;

/// Largest payload of a frame that needs no leave.
const MOST_IN_A_FRAME: usize = 16_384;

/// What the server may grow by, in megabytes, whatever is sent.
const MOST_GROWTH_MB: u64 = 100;

fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let mut bytes = (payload.len() as u32).to_be_bytes()[1..].to_vec();
    bytes.extend([kind, flags]);
    bytes.extend(stream.to_be_bytes());
    bytes.extend(payload);
    bytes
}

/// A call's header block, in HPACK without its table (RFC 7541, section 6.2.2 and appendix A).
fn call_headers() -> Vec<u8> {
    let text = |text: &str| [&[text.len() as u8][..], text.as_bytes()].concat();
    [
        // `:method: POST`, `:scheme: http`.
        vec![0x83, 0x86],
        [vec![0x04], text("/scpsfm.v1.CalibrationService/GetCapabilities")].concat(),
        [vec![0x01], text("localhost")].concat(),
        // `content-type`, entry 31.
        [vec![0x0f, 0x10], text("application/grpc")].concat(),
        [vec![0x00], text("te"), text("trailers")].concat(),
    ]
    .concat()
}

/// A server, and connections to it that do as they like.
struct Victim {
    server: Serving,
    before_mb: u64,
    _directory: tempfile::TempDir,
}

impl Victim {
    async fn start() -> Self {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let server = Serving::start(&directory.path().join("data"));
        is_served(&server.grpc).await;
        let before_mb = peak_mb(server.running.0.id());
        Self { server, before_mb, _directory: directory }
    }

    /// A connection after the preface and these settings.
    async fn connect(&self, settings: &[u8]) -> TcpStream {
        let address = self.server.grpc.trim_start_matches("http://");
        let mut connection = TcpStream::connect(address).await.expect("a connection");
        connection.write_all(&[PREFACE, &frame(SETTINGS, 0, 0, settings)].concat()).await.expect("written");
        connection
    }

    /// Others are served, now and on a connection that was there before; the server has not grown much.
    async fn is_well(&mut self, before: &mut CalibrationServiceClient<tonic::transport::Channel>) {
        is_served(&self.server.grpc).await;
        soon(before.get_capabilities(proto::GetCapabilitiesRequest {})).await.expect("the connection of before");
        assert!(self.server.running.0.try_wait().expect("it can be asked").is_none(), "the server has ended");
        let grown = peak_mb(self.server.running.0.id()) - self.before_mb;
        println!("{grown} MB more");
        assert!(grown < MOST_GROWTH_MB, "{grown} MB more");
    }

    async fn good_client(&self) -> CalibrationServiceClient<tonic::transport::Channel> {
        CalibrationServiceClient::connect(self.server.grpc.clone()).await.expect("a connection")
    }
}

/// Sends while somebody reads what comes back; ends early where the server ends the connection. Returns the types of
/// the frames that came.
async fn pour(connection: TcpStream, parts: impl Iterator<Item = Vec<u8>>) -> Vec<u8> {
    let (mut reader, mut writer) = connection.into_split();
    let reading = tokio::spawn(async move {
        let (mut kinds, mut head) = (Vec::new(), [0; 9]);
        while reader.read_exact(&mut head).await.is_ok() {
            kinds.push(head[3]);
            let length = u32::from_be_bytes([0, head[0], head[1], head[2]]) as usize;
            let mut payload = vec![0; length];
            if reader.read_exact(&mut payload).await.is_err() {
                break;
            }
        }
        kinds
    });
    for part in parts {
        if writer.write_all(&part).await.is_err() {
            break;
        }
    }
    let _ = writer.shutdown().await;
    soon(reading).await.expect("no panic")
}

/// The id of a client's stream of this number.
fn stream(number: u32) -> u32 {
    2 * number + 1
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn calls_that_are_reset_as_fast_as_they_come_hold_up_nobody() {
    let mut victim = Victim::start().await;
    let mut before = victim.good_client().await;
    let headers = call_headers();
    let reset = |number: u32| {
        let head = frame(HEADERS, END_HEADERS, stream(number), &headers);
        let cancel = frame(RST_STREAM, 0, stream(number), &8_u32.to_be_bytes());
        [head, cancel].concat()
    };
    for _ in 0..4 {
        let connection = victim.connect(&[]).await;
        let poured = pour(connection, (0..20_000).map(reset));
        let (_, ()) = tokio::join!(poured, is_served(&victim.server.grpc));
    }
    victim.is_well(&mut before).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn headers_without_end_are_not_kept() {
    let mut victim = Victim::start().await;
    let mut before = victim.good_client().await;
    // Literal headers with names and values of their own, 160 MB of them in one block that never ends.
    let mut block = Vec::new();
    while block.len() + 130 <= MOST_IN_A_FRAME {
        block.extend([&[0x00, 4][..], b"name", &[120], &[b'x'; 120]].concat());
    }
    let head = frame(HEADERS, 0, 1, &call_headers());
    let parts = std::iter::once(head).chain((0..10_000).map(|_| frame(CONTINUATION, 0, 1, &block)));
    let connection = victim.connect(&[]).await;
    soon(pour(connection, parts)).await;
    victim.is_well(&mut before).await;

    // One header of a kilobyte more than is taken, in a block that ends.
    let large = [&[0x00, 1][..], b"n", &[0x7f, 0xff, 0x7f], &[b'x'; 127 + 0x3fff]].concat();
    let (first, rest) = large.split_at(MOST_IN_A_FRAME / 2);
    let parts =
        [frame(HEADERS, END_STREAM, 1, &[&call_headers(), first].concat()), frame(CONTINUATION, END_HEADERS, 1, rest)];
    let connection = victim.connect(&[]).await;
    pour(connection, parts.into_iter()).await;
    victim.is_well(&mut before).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn streams_that_stall_and_questions_without_end_hold_up_nobody() {
    let mut victim = Victim::start().await;
    let mut before = victim.good_client().await;
    let headers = call_headers();
    // No answer may be sent: SETTINGS_INITIAL_WINDOW_SIZE is 0. Every other call says nothing more after its headers.
    let no_window = [0, 4, 0, 0, 0, 0];
    let mut stalled = Vec::new();
    for _ in 0..20 {
        let mut connection = victim.connect(&no_window).await;
        let calls = (0..500).map(|number| {
            let head = frame(HEADERS, END_HEADERS, stream(number), &headers);
            let body = if number % 2 == 0 { frame(DATA, END_STREAM, stream(number), &[0; 5]) } else { Vec::new() };
            [head, body].concat()
        });
        connection.write_all(&calls.collect::<Vec<_>>().concat()).await.expect("written");
        stalled.push(connection);
    }
    victim.is_well(&mut before).await;

    // Pings and settings, each of which asks for an answer; these are not read, but as far as the socket holds them.
    let questions = [frame(PING, 0, 0, &[7; 8]), frame(SETTINGS, 0, 0, &no_window)].concat().repeat(1_000);
    let mut asking = victim.connect(&[]).await;
    let asked = async {
        for _ in 0..100 {
            if asking.write_all(&questions).await.is_err() {
                break;
            }
        }
    };
    // Where the server stops to read, so does this.
    tokio::select! {
        () = asked => {}
        () = async { for _ in 0..20 { is_served(&victim.server.grpc).await } } => {}
    }
    victim.is_well(&mut before).await;
    drop((stalled, asking));
}
