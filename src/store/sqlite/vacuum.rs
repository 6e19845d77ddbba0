//! Giving the space of what was removed back to the disk: pages at a time, and only where that gives more than it
//! takes.

use super::connection::SqliteConnection;
use crate::store::Error;

/// Pages that are handed back at a time: writers wait meanwhile.
const PAGES: u64 = 1_024;
/// Hands as many back. Where others have to move for them, it is the log that holds these until it is written back, on
/// a full disk in the room that is kept.
pub(super) const VACUUM: &str = "PRAGMA incremental_vacuum(1024)";
/// What that is, in bytes, of SQLite's pages.
pub(super) const VACUUM_BYTES: u64 = PAGES * PAGE_BYTES;
/// Size of a page of databases that are created without asking for another.
const PAGE_BYTES: u64 = 4_096;
/// How often, each time that space is to be given back; others may write in between.
pub(super) const VACUUMS: u32 = 4;
/// Of so many pages that move one more changes, which tells where they are: 30 were counted beside 1,024, and twice
/// that is reckoned with.
const MOVED_A_POINTER: u64 = 16;

/// The database in pages.
#[derive(Debug, Clone, Copy)]
struct Pages {
    /// All of them, wherever they are.
    count: u64,
    /// Those that hold nothing.
    free: u64,
    /// Those that its file has room for; the others are in the log alone.
    in_file: u64,
}

impl Pages {
    /// Whether some of the free ones can be given back so that the log, with what moves for them, fits into the file
    /// and as many pages more as there is room for.
    ///
    /// Where it does not, each that moves would take room for nothing, from those who delete: it is they who make it
    /// fit.
    fn give_more_than_they_take(self, room: u64) -> bool {
        let used = self.count.saturating_sub(self.free);
        let fits = |given_back: u64| {
            let moved = given_back.min(used);
            let logged = moved + moved.div_ceil(MOVED_A_POINTER);
            let growth = (self.count - given_back.min(self.count)).saturating_sub(self.in_file);
            logged + growth <= room
        };
        (1..=self.free.div_ceil(PAGES)).any(|times| fits((times * PAGES).min(self.free)))
    }
}

impl SqliteConnection {
    /// Whether [`VACUUM`] is worth it, where so many bytes of the disk are kept for a time like this.
    pub(super) fn vacuum_pays(&mut self, kept: u64) -> Result<bool, Error> {
        let page = self.page_bytes()?;
        let free = self.number("PRAGMA freelist_count")?;
        let pages = Pages { count: self.bytes()? / page, free, in_file: self.file_bytes()? / page };
        Ok(free > 0 && pages.give_more_than_they_take(self.room()?.saturating_add(kept) / page))
    }

    /// Bytes that the file gives back to the disk once the log, which says so, is written back.
    pub(super) fn surplus(&mut self) -> Result<u64, Error> {
        Ok(self.file_bytes()?.saturating_sub(self.bytes()?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pages_move_only_where_the_log_can_be_written_back_for_it() {
        let pays = |count, free, in_file, room| Pages { count, free, in_file }.give_more_than_they_take(room);
        // A file that is as long as the database: a part at a time.
        assert!(pays(100_000, 50_000, 100_000, 1_100));
        assert!(!pays(100_000, 50_000, 100_000, 900));
        // Few that are used, few that move.
        assert!(pays(100_000, 99_900, 100_000, 110));
        assert!(!pays(100_000, 99_900, 100_000, 100));
        // All in the log: no part helps as long as the rest has no room in the file.
        assert!(!pays(10_000, 700, 40, 4_096));
        assert!(!pays(10_000, 5_000, 40, 4_096));
        // Those that are used take room in the log as they move, and in the file.
        assert!(!pays(10_000, 8_000, 40, 4_000));
        assert!(pays(10_000, 8_000, 40, 4_200));
        assert!(pays(10_000, 9_990, 40, 11));
        // None is free; all are, and without any room.
        assert!(!pays(10_000, 0, 10_000, 4_096));
        assert!(pays(1_000, 1_000, 10, 0));
    }
}
