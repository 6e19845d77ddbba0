//! What the commands that talk to a server add to the client: exit codes, flags in the place of settings, lines of files.

use prost::Message as _;

use super::access::with_flag;
use super::exit::{Exit, Failure, flag_named};
use crate::client::{Error, ErrorKind, InputData, Setting};
use crate::domain::Violation;
use crate::formats::LabelledInput;
use crate::rpc::convert::matches;

/// Longest set of matches that is sent, in bytes: half of the largest message that a server takes by default. Most
/// keypoints of a database are in no track, so that beyond this the tracks are far less to send.
const MAX_MATCH_SET_BYTES: usize = 32 << 20;

/// First parts of the fields that come from a file of tracks. All others come from flags.
const INPUT_FIELDS: [&str; 4] = ["track_set", "measurement_matrix", "match_set", "input"];

impl From<&LabelledInput> for InputData {
    /// Matches where the file has them. Joined here or there, they are the same tracks.
    fn from(input: &LabelledInput) -> Self {
        let set = input.raw_matches().map(matches::to_wire);
        match set.filter(|set| set.encoded_len() <= MAX_MATCH_SET_BYTES) {
            Some(set) => Self::MatchSet(set.into()),
            None => Self::from(&input.raw),
        }
    }
}

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        let exit = match error.kind {
            ErrorKind::Unavailable => Exit::Unavailable,
            ErrorKind::Invalid if !error.violations.iter().all(is_of_input) => Exit::Usage,
            ErrorKind::Usage => Exit::Usage,
            ErrorKind::Invalid | ErrorKind::Refused => Exit::BadInput,
            ErrorKind::NotLetIn => Exit::NotLetIn,
            ErrorKind::Cancelled => Exit::Interrupted,
            ErrorKind::Failed => Exit::Internal,
        };
        let mut message = match error.setting {
            Some(setting) => with_flag(&error.message, setting),
            None => in_terms_of_flags(error.message, &error.violations),
        };
        if (error.kind, error.setting) == (ErrorKind::Unavailable, Some(Setting::Server)) {
            message.push_str("; `scpsfm serve` starts one, --server or SCPSFM_SERVER names another");
        }
        if error.may_be_stored {
            message.push_str(
                ": look with `scpsfm list` before it is sent again. A command that had --request-id can be repeated as \
                 it is, and stores once",
            );
        }
        Failure { exit, message }
    }
}

/// A message of the server with the fields that flags set told as the flags.
fn in_terms_of_flags(message: String, violations: &[Violation]) -> String {
    let told = violations.iter().filter_map(|found| Some((found.path(), flag_of(&found.field)?)));
    told.fold(message, |message, (path, flag)| {
        let rest = message.strip_prefix(&format!("{path}: ")).map(|rest| format!("{flag}: {rest}"));
        rest.unwrap_or_else(|| message.replacen(&format!("; {path}: "), &format!("; {flag}: "), 1))
    })
}

/// The flag that sets a field; `None` of one that no flag sets.
fn flag_of(field: &str) -> Option<String> {
    Some(match field {
        "after_sequence" => "--after".to_owned(),
        "deadline" | "job.time_limit" => "--time-limit".to_owned(),
        "job.labels" => "--label".to_owned(),
        "job.webhook" | "job.webhook.url" => "--webhook".to_owned(),
        "parent" => "--tenant".to_owned(),
        "job.settings.use_daq" => "--no-daq".to_owned(),
        "filter" | "job_id" | "job.priority" | "page_size" | "page_token" | "request_id" => flag_named(field),
        _ => field.starts_with("job.settings.").then(|| flag_named(field))?,
    })
}

/// Tells what is wrong with the input by file and line: the server speaks of fields and indices, the user has lines.
pub fn at_lines(error: Error, input: &LabelledInput) -> Failure {
    if error.violations.iter().any(is_of_input) {
        return input.explain_all(&error.violations, 0).into();
    }
    error.into()
}

/// The same where each of several inputs is a request of one call.
pub fn at_lines_of(mut error: Error, inputs: &[LabelledInput]) -> Failure {
    let first = error.violations.first().and_then(|found| within_request(&found.field));
    let Some((index, input)) = first.and_then(|(index, _)| Some((index, inputs.get(index)?))) else {
        return error.into();
    };
    // The server tells of the first request that it refuses.
    let own = error.violations.iter().filter_map(|found| match within_request(&found.field) {
        Some((of, field)) if of == index => Some(Violation { field: field.to_owned(), ..found.clone() }),
        _ => None,
    });
    error.violations = own.collect();
    error.message = error.message.trim_start_matches(&format!("requests[{index}]: ")).to_owned();
    at_lines(error, input)
}

/// Number and field of `requests[3].track_set.xs`.
fn within_request(field: &str) -> Option<(usize, &str)> {
    let (index, field) = field.strip_prefix("requests[")?.split_once("].")?;
    Some((index.parse().ok()?, field))
}

/// Whether the fault is the input's. Every other field is one that a flag set.
fn is_of_input(violation: &Violation) -> bool {
    let first = violation.field.split('.').next().unwrap_or_default();
    INPUT_FIELDS.contains(&first)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error(kind: ErrorKind, message: &str) -> Error {
        kind.error(message)
    }

    #[test]
    fn fields_that_flags_set_are_wrong_usage_and_the_inputs_are_bad_input() {
        let exit = |violations: Vec<Violation>| {
            Failure::from(Error { violations, ..error(ErrorKind::Invalid, "is wrong") }).exit
        };
        let of = |field: &str| vec![Violation::of(field, "is wrong")];
        for flag in [
            "job.settings.alpha",
            "job.settings.backend",
            "job.labels",
            "job.time_limit",
            "job_id",
            "filter",
            "after_sequence",
        ] {
            assert_eq!(exit(of(flag)), Exit::Usage, "{flag}");
        }
        for input in ["track_set.xs", "track_set.views", "measurement_matrix.values", "match_set.xs", "input"] {
            assert_eq!(exit(of(input)), Exit::BadInput, "{input}");
        }
        assert_eq!(exit(Vec::new()), Exit::BadInput, "a malformed message");
    }

    #[test]
    fn fields_are_told_as_the_flags_that_set_them() {
        for (violations, message, told) in [
            (
                vec![Violation::of("job_id", "is no id"), Violation::at("job.labels", 2, "is empty")],
                "job_id: is no id; job.labels[2]: is empty",
                "--job-id: is no id; --label: is empty",
            ),
            (vec![Violation::of("job.webhook.url", "is no URL")], "job.webhook.url: is no URL", "--webhook: is no URL"),
            (vec![Violation::of("deadline", "is over")], "deadline: is over", "--time-limit: is over"),
            (vec![Violation::of("name", "is no name")], "name: is no name", "name: is no name"),
            (
                vec![Violation::at("track_set.xs", 3, "is not finite")],
                "track_set.xs[3]: is not finite",
                "track_set.xs[3]: is not finite",
            ),
        ] {
            assert_eq!(Failure::from(Error { violations, ..error(ErrorKind::Invalid, message) }).message, told);
        }
    }

    #[test]
    fn settings_are_told_as_flags_and_lost_answers_with_the_next_command() {
        let refused = Error {
            setting: Some(Setting::TlsCa),
            ..error(ErrorKind::NotLetIn, "nobody has signed it; `tls_ca` names others")
        };
        let failure = Failure::from(refused);
        assert_eq!(
            (failure.exit, failure.message.as_str()),
            (Exit::NotLetIn, "nobody has signed it; --tls-ca names others")
        );
        let away = Error { setting: Some(Setting::Server), ..error(ErrorKind::Unavailable, "no server answers") };
        let failure = Failure::from(away);
        assert_eq!(failure.exit, Exit::Unavailable);
        assert!(failure.message.starts_with("no server answers; `scpsfm serve` starts one"), "{failure}");
        let lost = Error { may_be_stored: true, ..error(ErrorKind::Unavailable, "it may have been stored") };
        assert!(Failure::from(lost).message.starts_with("it may have been stored: look with `scpsfm list`"));
    }
}
