//! `scpsfm upload`: leaves an input with a server.

use super::args::ServerArgs;
use super::exit::{Exit, Failure};
use super::input_args::{InputArgs, tell_notes};
use super::progress::TransferView;
use super::{print, remote};
use crate::client::EncodedInput;

const EXAMPLES: &str = "\
Examples:
  scpsfm upload observations.csv --width 3072 --height 2048
  input=$(scpsfm upload observations.csv) && scpsfm submit --input $input --method geometry";

/// Leave an input with a server, for any number of jobs
///
/// Prints the input's name, for `scpsfm submit --input NAME`. Goes on by itself where a connection breaks; stopped and
/// given again with the same tracks, it goes on where it was, and what the server has already it does not send again.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = format!("{EXAMPLES}\n\n{}", super::exit::HELP))]
pub struct Args {
    #[command(flatten)]
    pub input: InputArgs,

    #[command(flatten)]
    pub server: ServerArgs,

    /// No progress on stderr
    #[arg(long, short)]
    pub quiet: bool,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    let input = args.input.read()?;
    tell_notes(&input);
    let mut client = args.server.connect().await?;
    let encoded = EncodedInput::new(&input);
    let view = TransferView::new(args.quiet);
    let uploaded = client.upload(&encoded, &mut |bytes| view.show(bytes, encoded.len())).await;
    view.finish();
    let name = uploaded.map_err(|error| remote::at_lines(error, &input))?;
    print(&name.to_string())?;
    Ok(Exit::Done)
}
