//! How work that is done track by track, each some ten microseconds, is shared among threads.

use super::problem::Problem;
use super::recorder::Recorder;

/// Tracks that a thread takes at a time, and from how many on a second thread is worth its beginning.
pub const TRACKS_A_RUN: usize = 16;
pub const WORTH_A_THREAD: usize = 64;
/// Tracks between two entries of what was found: bounds what is found and not yet entered.
pub const BATCH: usize = 8_192;

/// Finds something of every track, of none by what was found of another, and enters it; ends where it is stopped.
pub fn each_track<S: Sync, T: Send>(
    problem: &Problem,
    tracks: &[usize],
    state: &mut S,
    recorder: &mut Recorder,
    find: impl Fn(&S, usize) -> Option<T> + Sync,
    enter: impl Fn(&mut S, usize, Option<T>),
) {
    let threads = problem.threads.if_worth(tracks.len() >= WORTH_A_THREAD);
    for batch in tracks.chunks(BATCH) {
        let standing = &*state;
        let of_track = |place: usize| match problem.stop.is_stopped() {
            true => None,
            false => find(standing, batch[place]),
        };
        let found = threads.map(batch.len(), TRACKS_A_RUN, of_track, &mut |_| recorder.heartbeat());
        if problem.stop.is_stopped() {
            return;
        }
        batch.iter().zip(found).for_each(|(&track, found)| enter(state, track, found));
    }
}
