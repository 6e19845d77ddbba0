//! Ballast for a full disk: a file of zeros, given up so that what was begun ends and what frees more is written.
//!
//! To cancel and to delete is to write, too. On a disk without a byte left an operator could do neither, jobs would
//! lose their leases with what they found, and a server that was restarted could not even open its store. Until there
//! is ballast again nothing new is begun: no job or upload is taken in, none that waits is claimed.

use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crate::store::Error;

/// The ballast within the data directory.
const BALLAST_FILE: &str = "scpsfm.reserve";

/// What is kept, in bytes: the log as long as it may grow before it is written back (1,000 pages, 4 MiB), the database
/// grown by as much, one [`VACUUM`](super::vacuum::VACUUM) and its pages in the log. The results of the jobs that run
/// seldom have more.
pub(super) const BALLAST_BYTES: u64 = 16 << 20;

/// What must be free beside it, in bytes, where it is made: as long as the log may grow, so that what is begun again
/// has room, and it is not given up again at once.
const BESIDE_BYTES: u64 = 4 << 20;

/// Between two attempts to restore the ballast: writers wait for each.
pub(super) const RETRY: Duration = Duration::from_secs(1);

/// The file of a data directory.
#[derive(Debug)]
pub(super) struct Ballast {
    path: PathBuf,
    is_whole: bool,
    /// When it was last tried to make it, and why there is none.
    tried: Option<(Instant, String)>,
    /// When its room was last given to others.
    given_up: Option<Instant>,
    has_room: Arc<AtomicBool>,
}

impl Ballast {
    /// The one of this directory. Where there is none, [`restore`](Self::restore) makes it.
    pub(super) fn of(directory: &Path) -> Self {
        let path = directory.join(BALLAST_FILE);
        let is_whole = std::fs::metadata(&path).is_ok_and(|file| file.len() == BALLAST_BYTES);
        Self { path, is_whole, tried: None, given_up: None, has_room: Arc::new(AtomicBool::new(true)) }
    }

    /// Whether there is room to begin something, for those who ask from other threads.
    pub(super) fn space_flag(&self) -> Arc<AtomicBool> {
        self.has_room.clone()
    }

    pub(super) fn is_whole(&self) -> bool {
        self.is_whole
    }

    /// Whether it was given up and is to be had back: not at once, so that the operation that it was given up for has
    /// its room.
    pub(super) fn is_due(&self) -> bool {
        let rests = self.given_up.is_some_and(|at| at.elapsed() < RETRY);
        !self.is_whole && !rests && !self.tried_lately()
    }

    fn tried_lately(&self) -> bool {
        self.tried.as_ref().is_some_and(|(at, _)| at.elapsed() < RETRY)
    }

    /// Whether there is ballast, made anew where it was given up and there is room again.
    pub(super) fn restore(&mut self) -> bool {
        if self.is_whole || self.tried_lately() {
            return self.is_whole;
        }
        match self.make() {
            Ok(()) => {
                self.is_whole = true;
                if self.tried.take().is_some() {
                    tracing::info!("room is kept for a full disk again");
                }
            }
            Err(error) => {
                let first = self.tried.replace((Instant::now(), error.to_string())).is_none();
                if first {
                    tracing::warn!(
                        error = %self.refusal(),
                        "the disk is full: nothing new is begun, what is left is for what ends or frees"
                    );
                }
            }
        }
        self.has_room.store(self.is_whole, Ordering::Relaxed);
        self.is_whole
    }

    /// Gives its room to others; `false` where there was none to give.
    pub(super) fn give_up(&mut self) -> bool {
        if !self.is_whole {
            return false;
        }
        match std::fs::remove_file(&self.path) {
            // That somebody else did so comes to the same: there is room, and none that is kept.
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                tracing::error!(%error, path = %self.path.display(), "cannot give up the room that is kept");
            }
            _ => (self.is_whole, self.given_up) = (false, Some(Instant::now())),
        }
        !self.is_whole
    }

    /// Why nothing new is begun.
    pub(super) fn refusal(&self) -> Error {
        let cause = self.tried.as_ref().map_or("", |(_, error)| error);
        let path = self.path.display();
        Error::NoSpace(format!("{} MiB cannot be kept in {path} for a full disk: {cause}", BALLAST_BYTES >> 20))
    }

    /// Under its own name only once it is whole, so that its length tells.
    fn make(&self) -> io::Result<()> {
        let draft = self.path.with_extension("reserve.new");
        let made = allocate(&draft, BALLAST_BYTES + BESIDE_BYTES)
            .and_then(|file| file.set_len(BALLAST_BYTES))
            .and_then(|()| std::fs::rename(&draft, &self.path));
        if made.is_err() {
            let _ = std::fs::remove_file(&draft);
        }
        made
    }
}

/// Makes a file that has its room on the disk.
fn allocate(path: &Path, bytes: u64) -> io::Result<File> {
    let mut file = File::create(path)?;
    #[cfg(any(target_os = "linux", target_vendor = "apple"))]
    match rustix::fs::fallocate(&file, rustix::fs::FallocateFlags::empty(), 0, bytes) {
        Ok(()) => return Ok(file),
        // Not every file system can.
        Err(rustix::io::Errno::OPNOTSUPP | rustix::io::Errno::NOSYS) => {}
        Err(error) => return Err(error.into()),
    }
    // No zeros: a file system may keep none of them.
    let block = [1; 65_536];
    for _ in 0..bytes / block.len() as u64 {
        file.write_all(&block)?;
    }
    file.sync_all()?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn length(ballast: &Ballast) -> Option<u64> {
        std::fs::metadata(&ballast.path).ok().map(|file| file.len())
    }

    #[test]
    fn what_was_given_up_is_made_again_once_there_is_room() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let mut ballast = Ballast::of(directory.path());
        let flag = ballast.space_flag();
        let has_room = || flag.load(Ordering::Relaxed);
        assert!(ballast.is_due() && length(&ballast).is_none(), "nothing is made before it is asked for");
        assert!(ballast.restore() && ballast.is_whole() && length(&ballast) == Some(BALLAST_BYTES));
        assert!(Ballast::of(directory.path()).is_whole(), "it is found again");
        assert!(ballast.give_up() && !ballast.is_whole() && length(&ballast).is_none());
        assert!(!ballast.give_up(), "it was given already");
        // Where its draft should stand is no room.
        let draft = ballast.path.with_extension("reserve.new");
        std::fs::create_dir(&draft).expect("a folder");
        assert!(has_room(), "it may yet be had back");
        assert!(!ballast.is_due(), "it is for whoever it was given up for");
        ballast.given_up = None;
        assert!(ballast.is_due() && !ballast.restore() && !ballast.is_whole() && !has_room());
        std::fs::remove_dir(&draft).expect("removed");
        assert!(!ballast.is_due() && !ballast.restore(), "not tried again at once");
        ballast.tried = None;
        assert!(ballast.restore() && has_room() && length(&ballast) == Some(BALLAST_BYTES) && !draft.exists());
    }

    #[test]
    fn one_that_was_cut_off_is_made_whole() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        std::fs::write(directory.path().join(BALLAST_FILE), [1; 1_000]).expect("written");
        let mut ballast = Ballast::of(directory.path());
        assert!(ballast.restore() && ballast.is_whole() && length(&ballast) == Some(BALLAST_BYTES));
    }
}
