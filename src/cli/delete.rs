//! `scpsfm delete`: removes jobs that have ended, and uploaded inputs.

use std::collections::HashSet;
use std::hash::Hash;

use super::args::ServerArgs;
use super::exit::{Exit, Failure};
use super::job_view::GivenName;
use super::print;
use super::submit::GivenInput;
use crate::client::{Client, OWN_TENANT};

const EXAMPLES: &str = "\
Examples:
  scpsfm delete a1b2 c3d4
  scpsfm delete --input 123e4567-e89b-42d3-a456-426614174000
  scpsfm list --all --state failed --json | jq -r .name | xargs -r scpsfm delete";

/// Delete jobs that have ended, and uploaded inputs
///
/// Removes each job with its input, events and result, for good, and prints its name. One that waits or runs is
/// refused: cancel it first. Of an uploaded input the name goes at once; jobs that were created with it go on, and its
/// bytes go with the last of them. Stops at the first that cannot be deleted.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = format!("{EXAMPLES}\n\n{}", super::exit::HELP))]
pub struct Args {
    /// The jobs' names, or the last parts of them
    #[arg(value_name = "JOB", required_unless_present = "inputs", value_parser = GivenName::parse)]
    pub names: Vec<GivenName>,

    /// An uploaded input: its name, or the last part of it; may be given more than once
    #[arg(long = "input", value_name = "NAME", value_parser = GivenInput::parse)]
    pub inputs: Vec<GivenInput>,

    #[command(flatten)]
    pub server: ServerArgs,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    // All of them are named before the first is gone, and one that is named twice goes once.
    let mut names = args.names.iter().map(|name| name.of(&args.server.access)).collect::<Result<Vec<_>, _>>()?;
    let mut inputs = args.inputs.iter().map(|given| given.of(&args.server.access)).collect::<Result<Vec<_>, _>>()?;
    let mut client = args.server.connect().await?;
    let tenants = names.iter_mut().map(|name| &mut name.tenant).chain(inputs.iter_mut().map(|name| &mut name.tenant));
    name_own_tenant(tenants, &mut client).await?;
    keep_first(&mut names);
    keep_first(&mut inputs);
    for name in names {
        client.delete(&name).await?;
        print(&name.to_string())?;
    }
    for name in inputs {
        client.delete_input(&name).await?;
        print(&name.to_string())?;
    }
    Ok(Exit::Done)
}

/// Replaces `-` by the id of the key's tenant. A job that is named both by its id and in full is then deleted once, and
/// the printed names are complete.
async fn name_own_tenant(tenants: impl Iterator<Item = &mut String>, client: &mut Client) -> Result<(), Failure> {
    let own: Vec<&mut String> = tenants.filter(|tenant| *tenant == OWN_TENANT).collect();
    if own.is_empty() {
        return Ok(());
    }
    // Of a tenant that has nothing, the server says that nothing is there.
    if let Some(id) = client.own_tenant().await? {
        own.into_iter().for_each(|tenant| tenant.clone_from(&id));
    }
    Ok(())
}

/// Leaves out what comes again.
fn keep_first<T: Clone + Eq + Hash>(names: &mut Vec<T>) {
    let mut seen = HashSet::new();
    names.retain(|name| seen.insert(name.clone()));
}
