//! `scpsfm inputs`: a server's uploaded inputs.

use serde_json::json;

use super::args::{PageArgs, ServerArgs};
use super::exit::{Exit, Failure};
use super::print;
use crate::domain::counted;
use crate::rpc::proto;

const EXAMPLES: &str = "\
Examples:
  scpsfm inputs
  scpsfm inputs --all --json | jq -r .name | xargs -r -n 1 scpsfm delete --input";

/// List uploaded inputs, the newest first
///
/// Prints one page, or all; where there are more, the token of the next page goes to stderr. Uploads not finished are
/// not listed. Bytes are those that were uploaded, which count against what the server lets a tenant have.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = format!("{EXAMPLES}\n\n{}", super::exit::HELP))]
pub struct Args {
    #[command(flatten)]
    pub server: ServerArgs,

    #[command(flatten)]
    pub page: PageArgs,

    /// One input a line, as JSON
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
pub async fn run(mut args: Args) -> Result<Exit, Failure> {
    let mut client = args.server.connect().await?;
    loop {
        let page = client.list_inputs(args.page.page_size, &args.page.page_token).await?;
        for input in &page.inputs {
            print(&if args.json { as_json(input) } else { line(input) })?;
        }
        if !args.page.next(page.next_page_token) {
            return Ok(Exit::Done);
        }
    }
}

fn created(input: &proto::Input) -> String {
    input.create_time.as_ref().map(ToString::to_string).unwrap_or_default()
}

fn line(input: &proto::Input) -> String {
    let proto::Input { name, size_bytes, view_count, track_count, .. } = input;
    let (views, tracks) = (counted(*view_count, "view"), counted(*track_count, "track"));
    format!("{name}  {}  {views}, {tracks}  {size_bytes} bytes", created(input))
}

fn as_json(input: &proto::Input) -> String {
    let sha256: String = input.sha256.iter().map(|byte| format!("{byte:02x}")).collect();
    json!({
        "name": input.name,
        "create_time": created(input),
        "bytes": input.size_bytes,
        "sha256": sha256,
        "views": input.view_count,
        "tracks": input.track_count,
        "observations": input.observation_count,
    })
    .to_string()
}
