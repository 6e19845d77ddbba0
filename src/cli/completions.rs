//! `scpsfm completions`: what a shell completes of a command line.

use clap_complete::Shell;

use super::exit::{Exit, Failure};
use super::print;

const EXAMPLES: &str = "\
Examples:
  scpsfm completions bash > ~/.local/share/bash-completion/completions/scpsfm
  scpsfm completions zsh > ~/.zfunc/_scpsfm
  scpsfm completions fish > ~/.config/fish/completions/scpsfm.fish";

/// Print a completion script for a shell
///
/// The script completes subcommands, flags and their values. It is that of this version of the program.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// Shell that reads the script
    #[arg(value_name = "SHELL", value_enum)]
    pub shell: Shell,
}

/// Runs the command.
pub fn run(args: Args) -> Result<Exit, Failure> {
    print(script(args.shell)?.trim_end())?;
    Ok(Exit::Done)
}

fn script(shell: Shell) -> Result<String, Failure> {
    let mut bytes = Vec::new();
    clap_complete::generate(shell, &mut super::command(), super::NAME, &mut bytes);
    String::from_utf8(bytes).map_err(Failure::internal)
}

#[cfg(test)]
mod tests {
    use clap::ValueEnum;

    use super::*;

    #[test]
    fn every_shell_completes_every_subcommand_and_flag() {
        let mut command = crate::cli::command();
        command.build();
        for &shell in Shell::value_variants() {
            let script = script(shell).expect("text").replace('\n', " ");
            for subcommand in command.get_subcommands() {
                assert!(script.contains(subcommand.get_name()), "{shell}: {}", subcommand.get_name());
                for flag in subcommand.get_arguments().filter_map(clap::Arg::get_long) {
                    let written = match shell {
                        Shell::Fish => format!("-l {flag} "),
                        _ => format!("--{flag}"),
                    };
                    assert!(script.contains(&written), "{shell}: {} {written}", subcommand.get_name());
                }
            }
        }
    }

    /// bash itself reads the script and completes the word that a user has begun.
    #[test]
    fn bash_completes_subcommands_flags_and_values() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("completions");
        std::fs::write(&path, script(Shell::Bash).expect("text")).expect("written");
        // As bash calls it: the command, the word and the one before it.
        let program = r#"source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1))
            _scpsfm scpsfm "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD - 1]}"; echo "${COMPREPLY[@]}""#;
        for (words, expected) in [
            (["scpsfm", "canc"].as_slice(), "cancel"),
            (&["scpsfm", "submit", "--request"], "--request-id"),
            (&["scpsfm", "solve", "--method", "geo"], "geometry"),
        ] {
            let bash = std::process::Command::new("bash").args(["-c", program, "bash"]).arg(&path).args(words).output();
            let output = match bash {
                Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                    eprintln!("SKIPPED the completion of words: no bash");
                    return;
                }
                output => output.expect("bash runs"),
            };
            assert_eq!(String::from_utf8_lossy(&output.stdout).trim(), expected, "{words:?}: {output:?}");
        }
    }
}
