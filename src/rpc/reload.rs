//! Files that are used while the server runs: read again when their content changes.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use sha2::{Digest, Sha256};
use tokio::sync::watch;

use crate::telemetry::metrics::{Reloaded, reload_failed};

/// Between two looks at the files. A change counts once two looks found the same, so that what is half written is not
/// taken: it is in force two to four seconds after its last byte.
pub const LOOK_EVERY: Duration = Duration::from_secs(2);

/// What files hold, as of their latest good content.
pub type Current<T> = watch::Receiver<Arc<T>>;

/// The content of the files, or that one could not be read. Content and not time: a mounted secret is a link that is
/// turned to another file, and clocks are coarse.
type Fingerprint = Vec<Option<[u8; 32]>>;

fn fingerprint(files: &[PathBuf]) -> Fingerprint {
    files.iter().map(|file| std::fs::read(file).ok().map(|bytes| Sha256::digest(bytes).into())).collect()
}

/// Loads what the files hold, and again whenever they change, as long as anyone holds what is returned. What cannot be
/// loaded changes nothing, is logged and stands in the metrics until it can.
///
/// * `load`: its error is a sentence that may be shown
///
/// # Errors
/// When the files cannot be loaded now.
pub async fn keep<T, L>(what: Reloaded, files: Vec<PathBuf>, every: Duration, load: L) -> Result<Current<T>, String>
where
    T: Send + Sync + 'static,
    L: Fn() -> Result<T, String> + Clone + Send + Sync + 'static,
{
    let (first_load, first_files) = (load.clone(), files.clone());
    let first = off_thread(move || (fingerprint(&first_files), first_load())).await?;
    let (loaded, value) = (first.0, Arc::new(first.1?));
    let (sender, current) = watch::channel(value);
    if !files.is_empty() {
        tokio::spawn(follow(what, files, every, load, loaded, sender));
    }
    Ok(current)
}

async fn follow<T, L>(
    what: Reloaded,
    files: Vec<PathBuf>,
    every: Duration,
    load: L,
    mut loaded: Fingerprint,
    current: watch::Sender<Arc<T>>,
) where
    T: Send + Sync + 'static,
    L: Fn() -> Result<T, String> + Clone + Send + Sync + 'static,
{
    let mut seen = loaded.clone();
    loop {
        tokio::select! {
            () = tokio::time::sleep(every) => {}
            () = current.closed() => return,
        }
        let looked = files.clone();
        let Ok(now) = off_thread(move || fingerprint(&looked)).await else { continue };
        let settled = now == seen;
        seen = now;
        if !settled || seen == loaded {
            continue;
        }
        let load = load.clone();
        match off_thread(load).await.and_then(|loaded| loaded) {
            Ok(value) => {
                current.send_replace(Arc::new(value));
                reload_failed(what, false);
                tracing::info!("the {what} changed and are in force");
            }
            Err(error) => {
                reload_failed(what, true);
                tracing::error!(error, "the {what} changed and cannot be used; the old ones stay in force");
            }
        }
        loaded.clone_from(&seen);
    }
}

/// Files may lie on a slow disk: not on a thread that serves others.
async fn off_thread<R: Send + 'static>(work: impl FnOnce() -> R + Send + 'static) -> Result<R, String> {
    tokio::task::spawn_blocking(work).await.map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_change_is_taken_and_one_that_makes_no_sense_is_not() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("number");
        let write = |text: &str| std::fs::write(&path, text).expect("written");
        write("1");
        let read = path.clone();
        let load = move || {
            let text = std::fs::read_to_string(&read).map_err(|error| error.to_string())?;
            text.parse::<u32>().map_err(|error| error.to_string())
        };
        let every = Duration::from_millis(5);
        let mut current = keep(Reloaded::Keys, vec![path.clone()], every, load.clone()).await.expect("a number");
        assert_eq!(**current.borrow_and_update(), 1);
        for (text, number) in [("2", 2), ("3", 3)] {
            // In between what is none, and no file at all: neither is ever in force.
            write("none");
            tokio::time::sleep(5 * every).await;
            std::fs::remove_file(&path).expect("removed");
            tokio::time::sleep(5 * every).await;
            write(text);
            current.changed().await.expect("followed");
            assert_eq!(**current.borrow_and_update(), number);
        }
        write("none");
        assert!(keep(Reloaded::Keys, vec![path], every, load).await.is_err());
    }
}
