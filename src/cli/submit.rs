//! `scpsfm submit`: leaves a job with a server.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use clap::builder::NonEmptyStringValueParser;

use super::access::AccessArgs;
use super::args::ServerArgs;
use super::exit::{Exit, Failure};
use super::input_args::{ReadingArgs, tell_notes};
use super::progress::TransferView;
use super::settings_args::SettingsArgs;
use super::{job_view, print, remote};
use crate::client::{JobInput, JobOptions};
use crate::domain::{InputName, Webhook};
use crate::formats::STANDARD_INPUT;
use crate::rpc::convert::create::MAX_PRIORITY;

const EXAMPLES: &str = "\
Examples:
  scpsfm submit observations.csv --width 3072 --height 2048
  scpsfm submit --input $(scpsfm upload observations.csv) --method geometry
  scpsfm submit scene-*.csv --width 3072 --height 2048
  scpsfm submit observations.csv --label site=north --time-limit 60 --watch
  job=$(scpsfm submit observations.csv) && scpsfm watch $job && scpsfm result $job --out answer";

/// Leave jobs with a server
///
/// Prints each job's name. The jobs go on without this command, and over restarts of the server. Of several inputs each
/// is a job of its own, with the same settings; all of them are stored, or none. An input that is larger than the
/// server's messages is uploaded first, and stays with the server as by `scpsfm upload`.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = format!("{EXAMPLES}\n\n{}", super::exit::HELP))]
pub struct Args {
    /// Tracks, as `scpsfm solve` takes them; `-`: standard input
    #[arg(value_name = "INPUT", conflicts_with = "uploaded")]
    pub inputs: Vec<PathBuf>,

    /// Solve an input that was uploaded with `scpsfm upload`: its name, or the last part of it; may be given more than
    /// once
    #[arg(long = "input", value_name = "NAME", value_parser = GivenInput::parse)]
    pub uploaded: Vec<GivenInput>,

    #[command(flatten)]
    pub reading: ReadingArgs,

    #[command(flatten)]
    pub server: ServerArgs,

    /// Follow the job to its end, as `scpsfm watch` does; for one input
    #[arg(long)]
    pub watch: bool,

    /// A mark to find the job by; may be given more than once
    #[arg(long = "label", value_name = "KEY=VALUE", value_parser = parse_label)]
    pub labels: Vec<(String, String)>,

    #[arg(long, value_name = "N", default_value_t = 0, allow_negative_numbers = true,
        help = format!("Larger is sooner, from -{MAX_PRIORITY} to {MAX_PRIORITY}"),
        value_parser = clap::value_parser!(i32).range(i64::from(-MAX_PRIORITY)..=i64::from(MAX_PRIORITY)))]
    pub priority: i32,

    /// Let the job expire when it has no result after this time
    #[arg(long, value_name = "SECONDS", value_parser = parse_seconds)]
    pub time_limit: Option<Duration>,

    /// Send the job's end to this URL, where the server's webhooks are on
    #[arg(long = "webhook", value_name = "URL", value_parser = parse_url)]
    pub webhook_url: Option<String>,

    /// Last part of the job's name, for one input; the server chooses one otherwise
    #[arg(long, value_name = "ID", value_parser = NonEmptyStringValueParser::new())]
    pub job_id: Option<String>,

    /// Makes this command safe to repeat: the same id and job give the same job. Of several inputs, each job has this
    /// id with `-1`, `-2`, ... after it
    #[arg(long, value_name = "ID", value_parser = NonEmptyStringValueParser::new())]
    pub request_id: Option<String>,

    #[command(flatten)]
    pub settings: SettingsArgs,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    let settings = args.settings.settings()?;
    let reading = args.reading.flags();
    if !args.uploaded.is_empty() && !reading.is_empty() {
        return Err(Failure::usage(format!(
            "{}: of no use with --input, whose tracks and image sizes are those of its upload; say it to \
             `scpsfm upload`",
            reading.trim_start()
        )));
    }
    let several = match args.inputs.len() + args.uploaded.len() {
        0 => return Err(nothing()),
        count => count > 1,
    };
    for (given, flag) in [(args.watch, "--watch"), (args.job_id.is_some(), "--job-id")] {
        if several && given {
            return Err(Failure::usage(format!("{flag} is for one input")));
        }
    }
    if args.inputs.iter().filter(|path| path.as_os_str() == STANDARD_INPUT).count() > 1 {
        return Err(Failure::usage("INPUT: `-` is given twice, and standard input is read once"));
    }
    let labels = labels(args.labels)?;
    let read = args.inputs.iter().map(|path| args.reading.read(path)).collect::<Result<Vec<_>, _>>()?;
    read.iter().for_each(tell_notes);
    let named = args.uploaded.iter().map(|given| given.of(&args.server.access)).collect::<Result<Vec<_>, _>>()?;
    let mut client = args.server.connect().await?;
    let options = JobOptions {
        job_id: args.job_id,
        request_id: args.request_id,
        labels,
        priority: args.priority,
        time_limit: args.time_limit,
        webhook_url: args.webhook_url,
    };
    let view = Arc::new(TransferView::new(false));
    let shown = Arc::clone(&view);
    client.on_upload(move |bytes, total| shown.show(bytes, total));
    let mut inputs: Vec<JobInput> = read.iter().map(JobInput::from).collect();
    inputs.extend(named.into_iter().map(JobInput::Uploaded));
    if several {
        let created = client.create_batch(inputs, &settings, &options).await;
        view.finish();
        let jobs = created.map_err(|error| remote::at_lines_of(error, &read))?;
        return jobs.iter().try_for_each(|job| print(&job.name.to_string())).map(|()| Exit::Done);
    }
    let input = inputs.pop().ok_or_else(nothing)?;
    let created = client.create(input, &settings, options).await;
    view.finish();
    let job = created.map_err(|error| match read.first() {
        Some(input) => remote::at_lines(error, input),
        None => error.into(),
    })?;
    print(&job.name.to_string())?;
    if args.watch {
        job_view::watch_to_end(&mut client, &args.server, &job.name, 0, false).await
    } else {
        Ok(Exit::Done)
    }
}

/// An uploaded input's name as it was given: whole, or its last part alone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum GivenInput {
    Whole(InputName),
    /// Of the tenant that calls; see [`job_view::own_id`].
    Id(String),
}

impl GivenInput {
    /// # Errors
    /// For what is neither.
    pub fn parse(text: &str) -> Result<Self, String> {
        let given = match job_view::own_id(text, "inputs") {
            Some(id) => Some(Self::Id(id.to_owned())),
            None => InputName::parse(text).map(Self::Whole),
        };
        given.ok_or_else(|| format!("{text:?} is not an input's name, as `scpsfm upload` prints it"))
    }

    /// The whole name.
    ///
    /// # Errors
    /// For a tenant that is none, and a flag that names another one, as wrong usage.
    pub fn of(&self, access: &AccessArgs) -> Result<InputName, Failure> {
        match self {
            Self::Whole(name) => access.tenant.check(&name.tenant, name).map(|()| name.clone()),
            Self::Id(input) => Ok(InputName { tenant: access.tenant()?, input: input.clone() }),
        }
    }
}

fn nothing() -> Failure {
    Failure::usage(
        "nothing says what to solve: give files of tracks (INPUT), or --input with the name of an uploaded input; see --help",
    )
}

fn parse_label(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((key, value)) if !key.is_empty() => Ok((key.to_owned(), value.to_owned())),
        _ => Err("is not of the form KEY=VALUE".into()),
    }
}

/// A job's labels; a key has one value.
fn labels(given: Vec<(String, String)>) -> Result<BTreeMap<String, String>, Failure> {
    let mut labels = BTreeMap::new();
    for (key, value) in given {
        if let Some(before) = labels.insert(key.clone(), value.clone()) {
            return Err(Failure::usage(format!("--label: {key:?} is given twice, as {before:?} and as {value:?}")));
        }
    }
    Ok(labels)
}

fn parse_url(text: &str) -> Result<String, String> {
    Webhook::parse_url(text).map(|_| text.to_owned())
}

fn parse_seconds(text: &str) -> Result<Duration, String> {
    let seconds: f64 = text.parse().map_err(|_| "is not a number of seconds".to_owned())?;
    match Duration::try_from_secs_f64(seconds) {
        Ok(duration) if duration > Duration::ZERO => Ok(duration),
        _ => Err("is not a positive number of seconds".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::access::TenantArg;

    #[test]
    fn an_input_may_be_given_in_full_or_by_its_id() {
        let of = |text: &str| {
            let tenant = TenantArg { id: Some("north".into()), is_flag: false };
            let access = AccessArgs { tenant, ..AccessArgs::default() };
            GivenInput::parse(text).map(|given| given.of(&access).expect("a tenant").to_string())
        };
        assert_eq!(of("a-1").as_deref(), Ok("tenants/north/inputs/a-1"));
        assert_eq!(of("tenants/south/inputs/a-1").as_deref(), Ok("tenants/south/inputs/a-1"));
        assert_eq!(of("tenants/-/inputs/a-1").as_deref(), Ok("tenants/north/inputs/a-1"), "as `delete` prints it");
        for bad in ["", "A", "inputs/a", "tenants/-/jobs/a", "tenants/-/inputs/", "tenants/-/inputs/a/b"] {
            assert!(of(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn a_label_that_is_given_twice_is_refused_by_its_key() {
        let given = |texts: &[&str]| labels(texts.iter().map(|text| parse_label(text).expect(text)).collect());
        let two = given(&["a=1", "b=1"]).expect("two keys");
        assert_eq!(two, BTreeMap::from([("a".into(), "1".into()), ("b".into(), "1".into())]));
        let refused = given(&["site=1", "b=1", "site=2"]).expect_err("one key");
        assert_eq!(refused.exit, Exit::Usage);
        assert!(refused.message.contains("\"site\""), "{refused}");
        assert!(given(&["a=1", "a=1"]).is_err(), "the same twice is a slip too");
    }
}
