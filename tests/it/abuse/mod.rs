//! Callers that mean harm, or know no better: bytes that are no message, and HTTP/2 that no client would speak.

mod bytes;
mod decoder;
mod http2;
mod memory;
