//! `scpsfm man`: manual pages.

use std::io;
use std::path::PathBuf;

use clap_mangen::Man;

use super::exit::{Exit, Failure};
use super::print;
use crate::formats::publish::{create_directory, write_atomically};

const EXAMPLES: &str = "\
Examples:
  scpsfm man | man -l -
  scpsfm man --out ~/.local/share/man/man1 && man scpsfm-solve";

/// Print the manual page, or write a page for each subcommand
///
/// The pages hold what --help shows.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// Directory for scpsfm.1 and a page for each subcommand, such as scpsfm-solve.1; created, files of these names in
    /// it are replaced
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
}

/// Runs the command.
pub fn run(args: Args) -> Result<Exit, Failure> {
    let pages = pages()?;
    match args.out {
        Some(out) => {
            create_directory(&out)?;
            pages.iter().try_for_each(|(name, page)| write_atomically(&out, name, page))?;
        }
        None => print(String::from_utf8_lossy(&pages[0].1).trim_end())?,
    }
    Ok(Exit::Done)
}

/// File name and text of each page, that of the program first.
fn pages() -> io::Result<Vec<(String, Vec<u8>)>> {
    let mut program = super::command().disable_help_subcommand(true);
    // Gives subcommands their full names.
    program.build();
    let mut pages = Vec::new();
    add(&program, &mut pages)?;
    Ok(pages)
}

fn add(command: &clap::Command, pages: &mut Vec<(String, Vec<u8>)>) -> io::Result<()> {
    let man = Man::new(command.clone()).source(format!("{} {}", super::NAME, env!("CARGO_PKG_VERSION")));
    let mut page = Vec::new();
    man.render(&mut page)?;
    pages.push((man.get_filename(), page));
    command.get_subcommands().try_for_each(|subcommand| add(subcommand, pages))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_subcommand_has_a_page_that_names_every_flag() {
        let pages = pages().expect("rendered");
        assert_eq!(pages[0].0, "scpsfm.1");
        let mut program = crate::cli::command();
        program.build();
        for subcommand in program.get_subcommands().filter(|subcommand| subcommand.get_name() != "help") {
            let name = format!("scpsfm-{}.1", subcommand.get_name());
            let (_, page) = pages.iter().find(|(file, _)| *file == name).unwrap_or_else(|| panic!("{name} is missing"));
            // A hyphen that is not to be broken at is written with a backslash.
            let page = String::from_utf8_lossy(page).replace('\\', "");
            for flag in subcommand.get_arguments().filter_map(clap::Arg::get_long) {
                assert!(page.contains(&format!("--{flag}")), "{name}: --{flag}");
            }
        }
    }
}
