//! What the readers of text share: lines of bounded length, numbers, foreign values in messages.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use super::error::{Error, Problem};
use super::input::display_path;
use crate::domain::Limits;

/// Longest line of a table in bytes, extra columns included. No table of numbers comes near; a binary file passes it
/// soon.
pub(super) const MAX_TABLE_LINE_BYTES: usize = 64 * 1024;
/// Bytes that one observation may take on average before the file cannot be within the limits: five columns of at
/// most 25 digits, and as much again for extra columns.
const MAX_BYTES_AN_OBSERVATION: u64 = 256;
/// Characters of a foreign value that an error message quotes.
const QUOTED_CHARS: usize = 40;
const UTF16_BOMS: [&[u8]; 2] = [b"\xFF\xFE", b"\xFE\xFF"];

/// Opens a table of one observation a line.
///
/// # Errors
/// A file that cannot be opened, is a directory or is larger than any table within `limits`.
pub(super) fn open_table(path: &Path, limits: &Limits) -> Result<BufReader<File>, Error> {
    let name = display_path(path);
    let cannot_read = |error: std::io::Error| Error::one(&name, Problem::unreadable(error));
    let metadata = std::fs::metadata(path).map_err(cannot_read)?;
    if metadata.is_dir() {
        return Err(Error::whole(&name, "is a directory, not a table"));
    }
    let most = MAX_BYTES_AN_OBSERVATION.saturating_mul(limits.max_observations as u64);
    if metadata.len() > most {
        let (bytes, most) = (metadata.len(), limits.max_observations);
        return Err(Error::whole(
            &name,
            format!("has {bytes} bytes, more than the limit of {most} observations can take"),
        ));
    }
    Ok(BufReader::new(File::open(path).map_err(cannot_read)?))
}

/// Lines of a file, each held to a bound, whatever its bytes.
pub(super) struct Lines<R> {
    reader: R,
    line: Vec<u8>,
    number: u64,
    most_bytes: usize,
}

impl<R: BufRead> Lines<R> {
    pub(super) fn new(reader: R, most_bytes: usize) -> Self {
        Self { reader, line: Vec::new(), number: 0, most_bytes }
    }

    /// Number of the line read last, counted from 1.
    pub(super) fn number(&self) -> u64 {
        self.number
    }

    /// Reads the next line; `false` at the end.
    pub(super) fn advance(&mut self) -> Result<bool, Problem> {
        self.line.clear();
        self.number += 1;
        let bound = self.most_bytes as u64 + 1;
        let read = self
            .reader
            .by_ref()
            .take(bound)
            .read_until(b'\n', &mut self.line)
            .map_err(|error| Problem::at_line(self.number, "", format!("cannot be read: {error}")))?;
        if read > self.most_bytes {
            let what = format!("longer than {} bytes; not a text file of this kind", self.most_bytes);
            return Err(Problem::at_line(self.number, "", what));
        }
        Ok(read > 0)
    }

    /// The bytes of the line read last, with what ends it.
    pub(super) fn bytes(&self) -> &[u8] {
        &self.line
    }

    /// The line read last, where it is text, without what ends it.
    pub(super) fn text(&self) -> Option<&str> {
        let text = std::str::from_utf8(&self.line).ok().filter(|text| !text.contains('\0'))?;
        let text = text.trim_end_matches(['\r', '\n']);
        Some(if self.number == 1 { text.trim_start_matches('\u{feff}') } else { text })
    }

    /// The same where anything but text is an error.
    pub(super) fn expect_text(&self) -> Result<&str, Problem> {
        self.text().ok_or_else(|| {
            if self.number == 1 {
                Problem::of_file(if is_utf16(&self.line) {
                    "is UTF-16 text; save it as UTF-8"
                } else {
                    "is not a text file"
                })
            } else {
                Problem::not_text(self.number)
            }
        })
    }
}

/// Whether a file that begins with this is UTF-16.
pub(super) fn is_utf16(beginning: &[u8]) -> bool {
    UTF16_BOMS.iter().any(|bom| beginning.starts_with(bom))
}

/// A foreign value as it may stand in a message: short, control characters escaped.
pub(super) fn quote(value: &str) -> String {
    let shown: String = value.chars().take(QUOTED_CHARS).flat_map(char::escape_debug).collect();
    let dots = if value.chars().nth(QUOTED_CHARS).is_some() { "..." } else { "" };
    format!("`{shown}{dots}`")
}

/// A whole number.
pub(super) fn whole<T: std::str::FromStr>(field: &str) -> Result<T, String> {
    field.parse().map_err(|_| match field {
        "" => "is empty".into(),
        digits if digits.bytes().all(|byte| byte.is_ascii_digit()) => format!("{} is too large a number", quote(field)),
        _ => format!("{} is not a whole number >= 0", quote(field)),
    })
}

/// NaN and infinities parse; [`LabelledInput::check`](super::LabelledInput::check) refuses them in its own words.
pub(super) fn number(field: &str) -> Result<f64, String> {
    field.parse().map_err(|_| match field {
        "" => "is empty; leave out the line of a point that was not observed".into(),
        _ => format!("{} is not a number", quote(field)),
    })
}
