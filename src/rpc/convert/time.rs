//! Times and durations. Protobuf's rules for both are checked here: prost's own conversions carry what breaks them over
//! into the seconds, so that a slip would become another time in silence.

use std::ops::RangeInclusive;
use std::time::{Duration, SystemTime};

use prost_types::Timestamp;

use crate::domain::Violation;

/// Nanoseconds beside whole seconds, of a time and of a positive duration (`google/protobuf/timestamp.proto`,
/// `duration.proto`); those of a time count forward before 1970 too.
const NANOS: RangeInclusive<i32> = 0..=999_999_999;

/// Seconds of a time: 0001-01-01T00:00:00Z to 9999-12-31T23:59:59Z (`google/protobuf/timestamp.proto`).
const TIME_SECONDS: RangeInclusive<i64> = -62_135_596_800..=253_402_300_799;

/// Longest duration, 100 years of 365.25 days: no job is meant to take so long, and a time so far from now is still one
/// that a `Timestamp` can tell, which the 10,000 years of `duration.proto` would not be.
const MAX_DURATION_SECONDS: i64 = 3_155_760_000;

/// A time from the wire.
///
/// # Errors
/// A violation of `field` for what is no valid `Timestamp`.
pub(crate) fn time_from_wire(time: Timestamp, field: &str) -> Result<SystemTime, Violation> {
    nanos(time.nanos, field)?;
    if !TIME_SECONDS.contains(&time.seconds) {
        let text = format!("{} seconds from 1970 are not in the years 1 to 9999", time.seconds);
        return Err(Violation::of(field, text));
    }
    time.try_into().map_err(|_| Violation::of(field, "is not a time that this system can represent"))
}

/// An optional time from the wire.
///
/// # Errors
/// See [`time_from_wire`].
pub(crate) fn optional_time(time: Option<Timestamp>, field: &str) -> Result<Option<SystemTime>, Violation> {
    time.map(|time| time_from_wire(time, field)).transpose()
}

/// An optional time for the wire; left out where a `Timestamp` cannot tell it, since one such time would make a whole
/// answer unreadable.
pub(crate) fn tellable(time: Option<SystemTime>) -> Option<Timestamp> {
    time.map(Timestamp::from).filter(|time| TIME_SECONDS.contains(&time.seconds))
}

/// A duration above 0 from the wire.
///
/// # Errors
/// A violation of `field` for what is no valid `Duration`, not positive or above a century.
pub(crate) fn positive_duration(duration: prost_types::Duration, field: &str) -> Result<Duration, Violation> {
    let prost_types::Duration { seconds, nanos: fraction } = duration;
    if seconds < 0 || (seconds == 0 && fraction <= 0) {
        return Err(Violation::of(field, "is not a positive duration"));
    }
    let nanos = nanos(fraction, field)?;
    if seconds > MAX_DURATION_SECONDS {
        return Err(Violation::of(field, format!("{seconds} seconds are above {MAX_DURATION_SECONDS}, a century")));
    }
    Ok(Duration::from_secs(seconds.unsigned_abs()) + nanos)
}

/// Seconds for the wire, to the nanosecond; 0 for what is no duration.
pub(crate) fn duration_to_wire(seconds: f64) -> prost_types::Duration {
    let duration = Duration::try_from_secs_f64(seconds).unwrap_or_default();
    let seconds = i64::try_from(duration.as_secs()).unwrap_or(i64::MAX);
    prost_types::Duration { seconds, nanos: duration.subsec_nanos().cast_signed() }
}

/// Seconds from the wire.
///
/// # Errors
/// A violation of `field` where it is missing, negative or no valid `Duration`.
pub(crate) fn seconds_from_wire(duration: Option<prost_types::Duration>, field: &str) -> Result<f64, Violation> {
    let duration = super::required(duration, field)?;
    if duration.seconds < 0 {
        return Err(Violation::of(field, "is negative"));
    }
    Ok((Duration::from_secs(duration.seconds.unsigned_abs()) + nanos(duration.nanos, field)?).as_secs_f64())
}

fn nanos(nanos: i32, field: &str) -> Result<Duration, Violation> {
    if !NANOS.contains(&nanos) {
        let text = format!("{nanos} nanoseconds are not in {}..={}", NANOS.start(), NANOS.end());
        return Err(Violation::of(field, text));
    }
    Ok(Duration::from_nanos(u64::from(nanos.unsigned_abs())))
}

#[cfg(test)]
mod tests {
    use std::time::UNIX_EPOCH;

    use super::*;

    fn time(seconds: i64, nanos: i32) -> Result<SystemTime, Violation> {
        time_from_wire(Timestamp { seconds, nanos }, "job.deadline_time")
    }

    fn duration(seconds: i64, nanos: i32) -> Result<Duration, Violation> {
        positive_duration(prost_types::Duration { seconds, nanos }, "job.time_limit")
    }

    #[test]
    fn valid_times_are_read_exactly() {
        assert_eq!(time(0, 0), Ok(UNIX_EPOCH));
        assert_eq!(time(1, 999_999_999), Ok(UNIX_EPOCH + Duration::new(1, 999_999_999)));
        assert_eq!(time(-1, 250_000_000), Ok(UNIX_EPOCH - Duration::from_millis(750)));
        for seconds in [*TIME_SECONDS.start(), *TIME_SECONDS.end()] {
            let read = time(seconds, 0).expect("the ends of the calendar");
            assert_eq!(Timestamp::from(read), Timestamp { seconds, nanos: 0 });
        }
        assert_eq!(Timestamp { seconds: *TIME_SECONDS.start(), nanos: 0 }.to_string(), "0001-01-01T00:00:00Z");
        assert_eq!(Timestamp { seconds: *TIME_SECONDS.end(), nanos: 0 }.to_string(), "9999-12-31T23:59:59Z");
    }

    #[test]
    fn times_beyond_the_calendar_are_left_out() {
        let last = UNIX_EPOCH + Duration::from_secs(TIME_SECONDS.end().unsigned_abs());
        assert_eq!(tellable(Some(last)).map(|time| time.seconds), Some(*TIME_SECONDS.end()));
        for beyond in [last + Duration::from_secs(1), UNIX_EPOCH + Duration::from_secs(3_000_000 * 86_400)] {
            assert_eq!(tellable(Some(beyond)), None);
        }
        assert_eq!(tellable(None), None);
    }

    #[test]
    fn times_that_protobuf_does_not_know_are_refused_by_field() {
        for (seconds, nanos) in [
            (0, -1),
            (0, 1_000_000_000),
            (10, i32::MIN),
            (10, i32::MAX),
            (TIME_SECONDS.start() - 1, 0),
            (TIME_SECONDS.end() + 1, 0),
            (i64::MIN, 0),
            (i64::MAX, 999_999_999),
        ] {
            let error = time(seconds, nanos).expect_err("no such time");
            assert_eq!(error.field, "job.deadline_time", "{seconds} s {nanos} ns");
        }
        assert_eq!(
            time(0, 1_000_000_000).expect_err("a whole second").to_string(),
            "job.deadline_time: 1000000000 nanoseconds are not in 0..=999999999"
        );
    }

    #[test]
    fn durations_are_positive_and_below_a_century() {
        assert_eq!(duration(0, 1), Ok(Duration::from_nanos(1)));
        assert_eq!(duration(90, 500_000_000), Ok(Duration::from_millis(90_500)));
        assert_eq!(duration(MAX_DURATION_SECONDS, 0), Ok(Duration::from_secs(3_155_760_000)));
        for (seconds, nanos) in [
            (0, 0),
            (0, -1),
            (-1, 0),
            // Together positive once normalised, and still not valid.
            (-1, 2_000_000_000),
            (2, -1),
            (0, 1_000_000_000),
            (MAX_DURATION_SECONDS + 1, 0),
            (i64::MAX, 0),
            (i64::MIN, 0),
        ] {
            let error = duration(seconds, nanos).expect_err("no such limit");
            assert_eq!(error.field, "job.time_limit", "{seconds} s {nanos} ns");
        }
    }
}
