//! The messages of a request as tonic is given them: whole, decompressed, and charged with what they take in memory.
//!
//! A message may decompress to a thousand times what came, and decode to sixty times that: both are charged before the
//! memory is taken, and refused where it is more than a message may take. Health checks and reflection are not the
//! API's: their messages pass as they come, within tonic's own bounds.

use std::io::Read;
use std::mem::take;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use flate2::bufread::GzDecoder;
use http_body::{Body as HttpBody, Frame};
use prost::bytes::{BufMut, Bytes, BytesMut};
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http::Request;

use super::access_log::CallRecord;
use super::auth::Lost;
use super::decoded_size::{self, MessageType};
use super::inflight::Permit;
use super::{inputs, status};

/// In front of each message: whether it is compressed (1) or not (0), and its length (four bytes, big-endian).
const HEADER_BYTES: usize = 5;
const UNCOMPRESSED: u8 = 0;
const COMPRESSED: u8 = 1;

/// Header that names the compression of the messages.
const ENCODING: &str = "grpc-encoding";

/// Bytes that are decompressed and charged at a time.
const CHUNK_BYTES: usize = 16 << 10;

/// Largest decoded size, in multiples of the largest message: a number of one byte takes four in a list, and eight where
/// the list has grown to twice its length.
const MOST_EXPANSION: u64 = 8;

/// Services whose messages have a smaller bound than others.
const OF_INPUTS: &str = "/scpsfm.v1.InputService/";

/// The body of a request in frames of one message each, none of them compressed by gzip.
pub struct MessageBody {
    body: Body,
    /// `None`: another service's than the API's.
    message_type: Option<MessageType>,
    is_gzip: bool,
    /// Largest message, compressed and decompressed.
    max_bytes: usize,
    /// What came of messages that are not whole yet.
    buffer: BytesMut,
    /// Whether what comes is handed on as it is, for tonic to judge.
    passes: bool,
    has_ended: bool,
    permit: Permit,
    record: Arc<CallRecord>,
    /// Ends with the key of the call; `None`: it has, and nothing follows.
    lost: Option<Lost>,
}

impl MessageBody {
    /// Puts the messages of a request in the place of its body. Its headers no longer say that they are compressed.
    ///
    /// * `max_bytes`: largest message, compressed and decompressed
    /// * `lost`: ends with the key of the call
    pub fn in_place(
        request: Request<Body>,
        max_bytes: usize,
        permit: Permit,
        record: Arc<CallRecord>,
        lost: Lost,
    ) -> Request<Self> {
        let (mut parts, body) = request.into_parts();
        let message_type = decoded_size::taken_by(parts.uri.path());
        let is_gzip = message_type.is_some() && parts.headers.get(ENCODING).is_some_and(|encoding| encoding == "gzip");
        if is_gzip {
            parts.headers.remove(ENCODING);
        }
        let of_service = if parts.uri.path().starts_with(OF_INPUTS) { inputs::MAX_MESSAGE_BYTES } else { usize::MAX };
        // The length of a message has four bytes.
        let max_bytes = max_bytes.min(of_service).min(u32::MAX as usize);
        let (buffer, passes) = (BytesMut::new(), message_type.is_none());
        let (has_ended, lost) = (false, Some(lost));
        let messages = Self { body, message_type, is_gzip, max_bytes, buffer, passes, has_ended, permit, record, lost };
        Request::from_parts(parts, messages)
    }

    /// The next message, with its header, once all of it came.
    fn next(&mut self) -> Result<Option<Bytes>, Status> {
        if self.passes {
            return Ok((!self.buffer.is_empty()).then(|| take(&mut self.buffer).freeze()));
        }
        let Some([flag, length @ ..]) = self.buffer.first_chunk::<HEADER_BYTES>() else { return Ok(None) };
        let (flag, length) = (*flag, u32::from_be_bytes(*length) as usize);
        if length > self.max_bytes {
            let text = format!("the message has {length} bytes, above the limit of {} bytes", self.max_bytes);
            return Err(Status::out_of_range(text));
        }
        let length = HEADER_BYTES + length;
        if self.buffer.len() < length {
            // At once, as far as a chunk of an upload goes: a buffer that doubles leaves its smaller ones behind.
            self.buffer.reserve((length - self.buffer.len()).min(inputs::MAX_MESSAGE_BYTES));
            return Ok(None);
        }
        // A part of the buffer would keep the whole in memory.
        let is_all = self.buffer.len() == length;
        let message = if is_all { take(&mut self.buffer) } else { self.buffer.split_to(length) };
        let message = match flag {
            UNCOMPRESSED => message,
            COMPRESSED if self.is_gzip => self.decompressed(&message[HEADER_BYTES..])?,
            // Compressed in another way, which tonic refuses.
            _ => return Ok(Some(message.freeze())),
        };
        if let Some(message_type) = self.message_type {
            self.charge_decoded(message_type, &message[HEADER_BYTES..])?;
        }
        Ok(Some(message.freeze()))
    }

    fn decompressed(&self, compressed: &[u8]) -> Result<BytesMut, Status> {
        let mut message = BytesMut::new();
        message.put_bytes(UNCOMPRESSED, HEADER_BYTES);
        let (mut decoder, mut chunk) = (GzDecoder::new(compressed), [0; CHUNK_BYTES]);
        loop {
            let count = match decoder.read(&mut chunk) {
                Ok(0) => break,
                Ok(count) => count,
                Err(error) => return Err(Status::internal(format!("the message cannot be decompressed: {error}"))),
            };
            if message.len() - HEADER_BYTES + count > self.max_bytes {
                let text = format!("the message has more than {} bytes once it is decompressed", self.max_bytes);
                return Err(Status::out_of_range(text));
            }
            self.permit.receive(count as u64)?;
            message.extend_from_slice(&chunk[..count]);
        }
        let length = (message.len() - HEADER_BYTES) as u32;
        message[1..HEADER_BYTES].copy_from_slice(&length.to_be_bytes());
        Ok(message)
    }

    /// Charges what a message takes while it is decoded: itself once more, in tonic's buffer, or decoded if that is more.
    fn charge_decoded(&self, message_type: MessageType, encoded: &[u8]) -> Result<(), Status> {
        let most = MOST_EXPANSION.saturating_mul(self.max_bytes as u64);
        let malformed =
            || Status::internal("the message cannot be decoded: it is cut, or a field ends beyond its message");
        let decoded = message_type.decoded_bytes(encoded, most).ok_or_else(malformed)?;
        if decoded > most {
            return Err(Status::out_of_range(format!("the message takes more than {most} bytes once it is decoded")));
        }
        self.permit.receive(decoded.max(encoded.len() as u64))
    }
}

impl HttpBody for MessageBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let Some(lost) = &mut self.lost else { return Poll::Ready(None) };
        if lost.as_mut().poll(context).is_ready() {
            self.lost = None;
            return Poll::Ready(Some(Err(status::withdrawn_key())));
        }
        loop {
            if let Some(message) = self.next().transpose() {
                return Poll::Ready(Some(message.map(Frame::data)));
            }
            if self.has_ended {
                return Poll::Ready(None);
            }
            match ready!(Pin::new(&mut self.body).poll_frame(context)).map(|frame| frame.map(Frame::into_data)) {
                Some(Ok(Ok(data))) => {
                    let bytes = data.len() as u64;
                    self.record.receive(bytes);
                    if let Err(refusal) = self.permit.receive(bytes) {
                        return Poll::Ready(Some(Err(refusal)));
                    }
                    self.buffer.extend_from_slice(&data);
                }
                Some(Ok(Err(trailers))) => return Poll::Ready(Some(Ok(trailers))),
                Some(Err(status)) => return Poll::Ready(Some(Err(status))),
                // What is left is no whole message, which tonic refuses.
                None => (self.has_ended, self.passes) = (true, true),
            }
        }
    }

    fn is_end_stream(&self) -> bool {
        self.lost.is_none() || self.buffer.is_empty() && (self.has_ended || self.body.is_end_stream())
    }
}

#[cfg(test)]
mod tests {
    use std::future::pending;
    use std::io::Write;

    use flate2::Compression;
    use flate2::write::GzEncoder;
    use http_body_util::StreamBody;
    use prost::Message;
    use tonic::Code;

    use super::*;
    use crate::rpc::inflight::Budget;
    use crate::rpc::proto::create_job_request::Source;
    use crate::rpc::proto::{CreateJobRequest, TrackSet, View};

    fn framed(flag: u8, message: &[u8]) -> Vec<u8> {
        [&[flag][..], &(message.len() as u32).to_be_bytes(), message].concat()
    }

    fn gzip(message: &[u8]) -> Vec<u8> {
        let mut encoder = GzEncoder::new(Vec::new(), Compression::default());
        encoder.write_all(message).expect("in memory");
        encoder.finish().expect("in memory")
    }

    fn request(views: usize, numbers: usize) -> Vec<u8> {
        let set = TrackSet { views: vec![View::default(); views], xs: vec![0.0; numbers], ..TrackSet::default() };
        CreateJobRequest { source: Some(Source::TrackSet(set)), ..CreateJobRequest::default() }.encode_to_vec()
    }

    const MAX_BYTES: usize = 100_000;

    const CREATE_JOB: &str = "/scpsfm.v1.JobService/CreateJob";

    fn given(bytes: &[u8], frame: usize, encoding: Option<&str>) -> (Vec<Bytes>, Option<Status>, u64) {
        given_to(CREATE_JOB, MAX_BYTES, bytes, frame, encoding)
    }

    /// What tonic is given of these bytes, which come in frames of that size, what refuses them, and what they are
    /// charged.
    fn given_to(
        path: &str,
        max_bytes: usize,
        bytes: &[u8],
        frame: usize,
        encoding: Option<&str>,
    ) -> (Vec<Bytes>, Option<Status>, u64) {
        let frames: Vec<_> =
            bytes.chunks(frame).map(|data| Ok::<_, Status>(Frame::data(Bytes::copy_from_slice(data)))).collect();
        let body = Body::new(StreamBody::new(futures_util::stream::iter(frames)));
        let mut request = Request::builder().uri(path);
        if let Some(encoding) = encoding {
            request = request.header(ENCODING, encoding);
        }
        let request = request.body(body).expect("a request");
        let (budget, record) = (Budget::new(u64::MAX), Arc::new(CallRecord::default()));
        let request =
            MessageBody::in_place(request, max_bytes, Permit::new(Arc::clone(&budget)), record, Box::pin(pending()));
        let is_taken = encoding == Some("gzip") && path.starts_with("/scpsfm");
        assert_eq!(request.headers().contains_key(ENCODING), encoding.is_some() && !is_taken);
        let mut messages = request.into_body();
        let mut context = Context::from_waker(std::task::Waker::noop());
        let (mut found, mut refusal) = (Vec::new(), None);
        while let Poll::Ready(Some(frame)) = Pin::new(&mut messages).poll_frame(&mut context) {
            match frame {
                Ok(frame) => found.push(frame.into_data().expect("data")),
                Err(status) => {
                    refusal = Some(status);
                    break;
                }
            }
        }
        (found, refusal, budget.used())
    }

    #[test]
    fn messages_are_whole_and_decompressed_however_they_come() {
        let [first, second] = [request(3, 5), request(0, 1_000)];
        let expected = [framed(UNCOMPRESSED, &first), framed(UNCOMPRESSED, &second)];
        let compressed = [framed(COMPRESSED, &gzip(&first)), framed(UNCOMPRESSED, &second)].concat();
        for (bytes, encoding) in [(expected.concat(), None), (compressed, Some("gzip"))] {
            for frame in [1, 7, 500, 1 << 20] {
                let (found, refusal, charged) = given(&bytes, frame, encoding);
                assert!(refusal.is_none(), "{refusal:?}");
                assert_eq!(found, expected);
                assert!(charged >= bytes.len() as u64 + 8_000, "{charged}");
            }
        }
    }

    #[test]
    fn what_a_message_decompresses_and_decodes_to_is_charged() {
        let message = request(100, 10_000);
        let (_, refusal, charged) = given(&framed(COMPRESSED, &gzip(&message)), 1 << 20, Some("gzip"));
        assert!(refusal.is_none(), "{refusal:?}");
        let least = (message.len() + 80_000 + 100 * size_of::<View>()) as u64;
        assert!(charged > least && charged < 3 * least, "{charged} of {least}");
    }

    #[test]
    fn what_takes_more_than_a_message_may_is_refused() {
        for (message, encoding) in [
            (framed(COMPRESSED, &gzip(&request(0, 20_000))), Some("gzip")),
            (framed(COMPRESSED, &gzip(&request(10_000, 0))), Some("gzip")),
            (framed(UNCOMPRESSED, &request(10_000, 0)), None),
            (framed(UNCOMPRESSED, &vec![0; MAX_BYTES + 1]), None),
            (framed(COMPRESSED, &vec![0; MAX_BYTES + 1]), Some("gzip")),
        ] {
            let (found, refusal, _) = given(&message, 1_000, encoding);
            assert!(found.is_empty());
            assert_eq!(refusal.expect("refused").code(), Code::OutOfRange);
        }
        let (_, refusal, _) = given(&framed(COMPRESSED, b"no gzip"), 1_000, Some("gzip"));
        assert_eq!(refusal.expect("refused").code(), Code::Internal, "tonic's word for it");
    }

    /// A message without its end, and a compression that is not known.
    #[test]
    fn what_tonic_refuses_is_handed_on() {
        let cut = framed(UNCOMPRESSED, &request(3, 5))[..20].to_vec();
        let unknown = framed(COMPRESSED, b"deflated");
        for (bytes, encoding) in [(cut, None), (unknown.clone(), Some("deflate")), (unknown, None)] {
            let (found, refusal, _) = given(&bytes, 1_000, encoding);
            assert!(refusal.is_none(), "{refusal:?}");
            assert_eq!(found.concat(), bytes);
        }
        let health = framed(COMPRESSED, &gzip(&[0; 1_000]));
        let (found, refusal, charged) =
            given_to("/grpc.health.v1.Health/Check", MAX_BYTES, &health, 1_000, Some("gzip"));
        assert!(refusal.is_none(), "{refusal:?}");
        assert_eq!((found.concat(), charged), (health.clone(), health.len() as u64));
    }

    #[test]
    fn chunks_of_uploads_have_their_own_bound() {
        let chunk = framed(COMPRESSED, &gzip(&vec![0; inputs::MAX_MESSAGE_BYTES + 1]));
        let refused = |path: &str| {
            let (_, refusal, charged) = given_to(path, 64 << 20, &chunk, 1_000, Some("gzip"));
            (refusal.expect("refused").code(), charged)
        };
        let (code, charged) = refused("/scpsfm.v1.InputService/UploadInput");
        assert_eq!(code, Code::OutOfRange);
        assert!(charged <= (inputs::MAX_MESSAGE_BYTES + chunk.len()) as u64, "{charged}");
        // To others it is not too large, but malformed.
        assert_eq!(refused(CREATE_JOB).0, Code::Internal);
    }

    #[test]
    fn what_cannot_be_decoded_is_not_handed_on() {
        // A set of six bytes whose numbers take a thousand.
        let overlong = [&[0x2a, 6, 0x2a, 0xe8, 0x07][..], &[0; 1_000]].concat();
        let compressed = framed(COMPRESSED, &gzip(&overlong));
        for (message, encoding) in [(framed(UNCOMPRESSED, &overlong), None), (compressed, Some("gzip"))] {
            let (found, refusal, _) = given(&message, 1_000, encoding);
            assert!(found.is_empty());
            assert_eq!(refusal.expect("refused").code(), Code::Internal, "tonic's word for it");
        }
    }
}
