//! The binary files of a model: little-endian, each list after its count (COLMAP, `reconstruction_io_binary.cc`).

use std::io::{BufRead, ErrorKind, Read};

use super::super::cameras::{Camera, Model};
use super::super::images::{Images, Observation};
use super::{NO_POINT, ReadBounds};
use crate::domain::Limits;
use crate::domain::View;
use crate::formats::error::{Error, Problem};

/// Bytes of a camera without parameters, of an image without name and points, and of a keypoint.
const CAMERA_BYTES: u64 = 24;
const IMAGE_BYTES: u64 = 73;
const POINT_BYTES: u64 = 24;

/// Reads `cameras.bin`: id u32, model i32, width u64, height u64, parameters f64.
pub(super) fn cameras(reader: impl BufRead, file: &str, length: Option<u64>, images: &mut Images) -> Result<(), Error> {
    let mut bytes = Bytes { reader, file, length, offset: 0, record: "the count of cameras".into() };
    for k in 0..bytes.count("cameras", CAMERA_BYTES)? {
        bytes.record = format!("camera {k} of the file");
        let id = bytes.u32()?;
        bytes.record = format!("camera {id}");
        let start = bytes.offset;
        let number = i64::from(bytes.u32()?.cast_signed());
        let model = Model::of_id(number).ok_or_else(|| {
            bytes.wrong_at(start, format!("model {number} is not one of COLMAP's; the file may be damaged"))
        })?;
        let (width, height) = (bytes.u64()?, bytes.u64()?);
        for _ in 0..model.parameters {
            bytes.f64()?;
        }
        Camera::new(Some(model), width, height)
            .and_then(|camera| images.add_camera(id, camera))
            .map_err(|what| bytes.wrong_at(start, what))?;
    }
    bytes.end()
}

/// Reads `images.bin`: id u32, rotation 4 f64, translation 3 f64, camera u32, name up to a zero, then each keypoint: x,
/// y f64, point u64. Returns the keypoints that belong to a point.
pub(super) fn images(
    reader: impl BufRead,
    file: &str,
    length: Option<u64>,
    limits: &Limits,
    images: &mut Images,
) -> Result<Vec<Observation>, Error> {
    let bounds = ReadBounds::new(limits);
    let mut bytes = Bytes { reader, file, length, offset: 0, record: "the count of images".into() };
    let mut observations = Vec::new();
    for k in 0..bytes.count("images", IMAGE_BYTES)? {
        bytes.record = format!("image {k} of the file");
        let start = bytes.offset;
        let id = bytes.u32()?;
        bytes.record = format!("image {id}");
        for _ in 0..7 {
            bytes.f64()?;
        }
        let camera = bytes.u32()?;
        let name = bytes.name()?;
        let image = images.add_image(id, &name, camera).map_err(|what| bytes.wrong_at(start, what))?;
        for _ in 0..bytes.count("keypoints", POINT_BYTES)? {
            let (x, y, track) = (bytes.f64()?, bytes.f64()?, bytes.u64()?);
            let keypoint = images.add_keypoint(image, x, y);
            if track != NO_POINT {
                observations.push(Observation { image, keypoint, track, x, y, line: 0 });
            }
            bounds.check(images, &observations).map_err(|what| bytes.wrong_at(bytes.offset, what))?;
        }
        bounds.check(images, &observations).map_err(|what| bytes.wrong_at(start, what))?;
    }
    bytes.end()?;
    Ok(observations)
}

/// A file that is read from front to back.
struct Bytes<'a, R> {
    reader: R,
    file: &'a str,
    /// Bytes of the file, where known.
    length: Option<u64>,
    /// Bytes read so far.
    offset: u64,
    /// What is being read.
    record: String,
}

impl<R: BufRead> Bytes<'_, R> {
    fn wrong_at(&self, offset: u64, what: impl Into<String>) -> Error {
        Error::one(self.file, Problem::at_byte(offset, &self.record, what))
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], Error> {
        let mut bytes = [0; N];
        self.reader.read_exact(&mut bytes).map_err(|error| match error.kind() {
            ErrorKind::UnexpectedEof => self.wrong_at(self.offset, "the file ends here; it may be truncated"),
            _ => self.wrong_at(self.offset, format!("cannot be read: {error}")),
        })?;
        self.offset += N as u64;
        Ok(bytes)
    }

    fn u32(&mut self) -> Result<u32, Error> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, Error> {
        self.take().map(u64::from_le_bytes)
    }

    fn f64(&mut self) -> Result<f64, Error> {
        self.take().map(f64::from_le_bytes)
    }

    /// A count of records of at least `each` bytes. One that the file has no room for is refused at once; none is
    /// trusted with memory.
    fn count(&mut self, what: &str, each: u64) -> Result<u64, Error> {
        let start = self.offset;
        let count = self.u64()?;
        let left = self.length.map(|length| length.saturating_sub(self.offset) / each);
        match left {
            Some(left) if count > left => Err(self.wrong_at(
                start,
                format!("{count} {what} are announced, the file has room for {left}; it may be truncated"),
            )),
            _ => Ok(count),
        }
    }

    /// Text up to a zero.
    fn name(&mut self) -> Result<String, Error> {
        let start = self.offset;
        let mut name = Vec::new();
        let most = View::MAX_NAME_BYTES as u64 + 1;
        let read = self.reader.by_ref().take(most).read_until(0, &mut name);
        self.offset += read.map_err(|error| self.wrong_at(start, format!("cannot be read: {error}")))? as u64;
        if name.pop() != Some(0) {
            return Err(self.wrong_at(start, "the image's name does not end; the file may be damaged"));
        }
        String::from_utf8(name).map_err(|_| self.wrong_at(start, "the image's name is not UTF-8"))
    }

    /// Refuses what comes after the last record.
    fn end(mut self) -> Result<(), Error> {
        match self.reader.fill_buf() {
            Ok([]) => Ok(()),
            Ok(_) => Err(self.wrong_at(self.offset, "the file goes on after its last record")),
            Err(error) => Err(self.wrong_at(self.offset, format!("cannot be read: {error}"))),
        }
    }
}
