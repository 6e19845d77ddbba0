//! The list of the files that a run wrote, kept beside them: by it, and by nothing else, a later run into the same
//! directory knows what it may take away.
//!
//! A file goes only if it still is what was written, to the last byte, and those of a model only together: a model that
//! another program has refined, a table that somebody has edited, files of earlier versions, which kept no list, all
//! stay.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{self, BufReader, Read};
use std::path::{Component, Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Name of the list.
pub const NAME: &str = "scpsfm-files.json";
/// Longest list that is read, in bytes: some ten files a reconstruction, a few hundred bytes each, and room.
const MOST_BYTES: u64 = 16 << 20;
/// Bytes of a file that are summed up at a time.
const CHUNK_BYTES: usize = 1 << 16;

/// A file as it was written.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Written {
    /// Below the directory, parts separated by `/`.
    path: String,
    bytes: u64,
    /// In hexadecimal digits.
    sha256: String,
}

impl Written {
    /// * `path`: below the directory
    pub fn new(path: &Path, bytes: &[u8]) -> Self {
        let parts: Vec<_> = path.iter().map(|part| part.to_string_lossy()).collect();
        Self { path: parts.join("/"), bytes: bytes.len() as u64, sha256: format!("{:x}", Sha256::digest(bytes)) }
    }

    /// Of a file that stands at `place` and is to be at `path` below the directory.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn of_file(path: &Path, place: &Path) -> io::Result<Self> {
        let bytes = place.symlink_metadata()?.len();
        Ok(Self { bytes, sha256: sha256(place)?, ..Self::new(path, &[]) })
    }

    /// Below the directory, parts separated by `/`.
    pub fn path(&self) -> &str {
        &self.path
    }

    /// Where it is; `None` for what is not below the directory, which no run wrote.
    pub fn place(&self, directory: &Path) -> Option<PathBuf> {
        let path = Path::new(&self.path);
        let below = path.components().all(|part| matches!(part, Component::Normal(_)));
        (below && !self.path.is_empty()).then(|| directory.join(path))
    }

    /// Whether it stands there as it was written.
    pub fn stands(&self, directory: &Path) -> bool {
        self.place(directory).is_some_and(|place| self.is(&place).unwrap_or(false))
    }

    fn is(&self, place: &Path) -> io::Result<bool> {
        let metadata = place.symlink_metadata()?;
        if !metadata.is_file() || metadata.len() != self.bytes {
            return Ok(false);
        }
        Ok(sha256(place)? == self.sha256)
    }
}

/// In hexadecimal digits.
fn sha256(place: &Path) -> io::Result<String> {
    let (mut file, mut sum, mut chunk) = (File::open(place)?, Sha256::new(), vec![0; CHUNK_BYTES]);
    loop {
        match file.read(&mut chunk)? {
            0 => return Ok(format!("{:x}", sum.finalize())),
            count => sum.update(&chunk[..count]),
        }
    }
}

/// The list.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Manifest {
    /// The file that stands only while the others do, and was written last.
    pub last: String,
    pub files: Vec<Written>,
}

impl Manifest {
    /// The list in this directory; an empty one where there is none that can be read.
    pub fn read(directory: &Path) -> Self {
        let read = || -> Option<Self> {
            let file = File::open(directory.join(NAME)).ok()?;
            serde_json::from_reader(BufReader::new(file.take(MOST_BYTES))).ok()
        };
        read().unwrap_or_default()
    }

    /// Where the files are, but for those that were `replaced`, that stand as they were written. A run that was killed
    /// may have listed a file twice, as it was and as it was to be: either will do. Of a folder below the directory,
    /// whose files make sense together, none is removable once one was changed by others.
    pub fn removable(&self, directory: &Path, replaced: &[PathBuf]) -> Vec<PathBuf> {
        let mut standing: BTreeMap<PathBuf, bool> = BTreeMap::new();
        let is_there = |place: &PathBuf| !replaced.contains(place) && place.symlink_metadata().is_ok();
        for file in &self.files {
            if let Some(place) = file.place(directory).filter(is_there) {
                *standing.entry(place).or_default() |= file.stands(directory);
            }
        }
        let changed: BTreeSet<PathBuf> = standing
            .iter()
            .filter(|(_, stands)| !**stands)
            .filter_map(|(place, _)| place.parent())
            .filter(|folder| *folder != directory)
            .map(Path::to_owned)
            .collect();
        let whole = |place: &PathBuf| place.parent().is_none_or(|folder| !changed.contains(folder));
        standing.into_iter().filter(|(place, stands)| *stands && whole(place)).map(|(place, _)| place).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_known_to_the_last_byte_and_only_below_the_directory() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let inner = directory.path().join("inner");
        std::fs::create_dir_all(inner.join("colmap")).expect("created");
        std::fs::write(inner.join("colmap/points"), "abc").expect("written");
        std::fs::write(directory.path().join("secret"), "abc").expect("written");
        let of = |path: &str| Written { path: path.into(), ..Written::new(Path::new("x"), b"abc") };
        assert_eq!(Written::new(&Path::new("colmap").join("points"), b"abc"), of("colmap/points"));
        assert!(of("colmap/points").stands(&inner));
        let outside = inner.join("colmap/points").to_string_lossy().into_owned();
        for path in ["colmap/other", "colmap", "../secret", "colmap/../../secret", "", outside.as_str()] {
            assert!(!of(path).stands(&inner), "{path}");
        }
        for changed in ["abd", "abcd", ""] {
            std::fs::write(inner.join("colmap/points"), changed).expect("written");
            assert!(!of("colmap/points").stands(&inner), "{changed:?}");
        }
    }

    #[test]
    fn what_is_no_list_lists_nothing() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        assert_eq!(Manifest::read(directory.path()), Manifest::default());
        for text in ["", "[]", "{\"files\": 3}", "{\"files\": [{\"path\": 1}], \"last\": \"\"}"] {
            std::fs::write(directory.path().join(NAME), text).expect("written");
            assert_eq!(Manifest::read(directory.path()), Manifest::default(), "{text}");
        }
    }
}
