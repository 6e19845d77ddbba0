//! Log lines that anyone outside can cause: so many a minute, then one that tells how many were left out.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::runtime::Handle;
use tokio::time::{Instant, sleep_until};

/// Lines of a minute: enough to see who causes them, and too few to drown the rest.
const LINES: u32 = 10;

const MINUTE: Duration = Duration::from_secs(60);

/// Counts the lines of one kind. Clones count together.
#[derive(Debug, Clone)]
pub struct Throttle {
    /// Of a minute.
    lines: u32,
    window: Arc<Mutex<Window>>,
}

impl Default for Throttle {
    fn default() -> Self {
        Self::of(LINES)
    }
}

/// The minute that began with its first line.
#[derive(Debug, Default)]
struct Window {
    end: Option<Instant>,
    lines: u32,
    left_out: u64,
}

impl Throttle {
    /// So many lines a minute, and one more with the number of those that were left out.
    pub fn of(lines: u32) -> Self {
        Self { lines, window: Arc::default() }
    }

    /// Whether a line may be written now. Of those that may not, `report` gets the number at the end of the minute.
    pub fn allows(&self, report: impl FnOnce(u64) + Send + 'static) -> bool {
        let now = Instant::now();
        let mut window = self.window.lock().unwrap_or_else(PoisonError::into_inner);
        if window.end.is_none_or(|end| end <= now) {
            // What the minute before left out is about to be reported by its task.
            *window = Window { end: Some(now + MINUTE), lines: 0, left_out: window.left_out };
        }
        if window.lines < self.lines {
            window.lines += 1;
            return true;
        }
        window.left_out += 1;
        if window.left_out == 1
            && let (Some(end), Ok(runtime)) = (window.end, Handle::try_current())
        {
            let throttle = self.clone();
            runtime.spawn(async move {
                sleep_until(end).await;
                let mut window = throttle.window.lock().unwrap_or_else(PoisonError::into_inner);
                let left_out = std::mem::take(&mut window.left_out);
                drop(window);
                report(left_out);
            });
        }
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn a_minute_has_so_many_lines_and_then_how_many_were_left_out() {
        let throttle = Throttle::default();
        let told = Arc::new(Mutex::new(Vec::new()));
        let written = |count: usize| {
            let allowed = (0..count).filter(|_| {
                let told = told.clone();
                throttle.allows(move |left_out| told.lock().expect("lock").push(left_out))
            });
            allowed.count()
        };
        assert_eq!(written(1_000), LINES as usize);
        assert!(told.lock().expect("lock").is_empty());
        tokio::time::sleep(MINUTE + Duration::from_millis(1)).await;
        assert_eq!(*told.lock().expect("lock"), [1_000 - u64::from(LINES)]);
        assert_eq!(written(3), 3, "a new minute");
        tokio::time::sleep(2 * MINUTE).await;
        assert_eq!(told.lock().expect("lock").len(), 1, "nothing was left out");
        assert_eq!(written(LINES as usize + 1), LINES as usize);
        tokio::time::sleep(MINUTE + Duration::from_millis(1)).await;
        assert_eq!(told.lock().expect("lock")[1..], [1]);
    }
}
