//! The unit of systemd fits the program that it starts.

use std::fs;
use std::io::Write;
use std::path::PathBuf;
use std::process::Command;

use scpsfm::config::Config;

use crate::support::program::{program, run};

/// Seconds that a server takes at most to stop what its drain left: docs/operation.md tells them.
const STOP_SECONDS: u64 = 27;

fn deployed(name: &str) -> String {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("deploy/systemd").join(name);
    fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The value of a key that stands once.
fn value<'a>(unit: &'a str, key: &str) -> &'a str {
    let mut values = unit.lines().filter_map(|line| line.strip_prefix(key)?.strip_prefix('='));
    let value = values.next().unwrap_or_else(|| panic!("{key} is missing"));
    assert_eq!(values.next(), None, "{key} stands twice");
    value
}

/// The settings of a file for the environment, those that are commented out too.
fn settings(file: &str) -> Vec<(&str, &str)> {
    let lines = file.lines().map(|line| line.trim_start_matches("# "));
    lines.filter(|line| line.starts_with("SCPSFM_")).filter_map(|line| line.split_once('=')).collect()
}

#[test]
fn the_program_knows_the_command_line_and_every_setting() {
    let unit = deployed("scpsfm.service");
    let mut words = value(&unit, "ExecStart").split_whitespace();
    assert_eq!(words.next(), Some("/usr/local/bin/scpsfm"));
    let arguments: Vec<&str> = words.collect();
    let file = deployed("scpsfm.env");
    let settings = settings(&file);
    assert!(settings.len() > 5, "{settings:?}");
    let mut serve = program(arguments);
    let output = serve.arg("--print-config").envs(settings.iter().copied()).output().expect("the program runs");
    assert!(output.status.success(), "{output:?}");
    let printed = String::from_utf8(output.stdout).expect("UTF-8");
    assert!(printed.contains("data_dir = \"/var/lib/scpsfm\""), "{printed}");
    assert!(printed.contains("keys_file = \"/etc/scpsfm/keys.txt\""), "{printed}");
    assert_eq!(value(&unit, "StateDirectory"), "scpsfm");
    assert_eq!(value(&unit, "EnvironmentFile"), "/etc/scpsfm/scpsfm.env");
}

#[test]
fn a_drain_and_all_connections_fit_into_the_units_bounds() {
    let (unit, config) = (deployed("scpsfm.service"), Config::default());
    let stop: u64 = value(&unit, "TimeoutStopSec").parse().expect("seconds");
    assert!(stop > config.engine.drain_seconds + STOP_SECONDS, "{stop}");
    let operation = include_str!("../../docs/operation.md");
    assert!(operation.contains(&format!("`drain_seconds` plus {STOP_SECONDS} s")));
    let files: usize = value(&unit, "LimitNOFILE").parse().expect("a number");
    assert!(files > 2 * config.server.max_connections, "{files}");
    // No restart mends a configuration.
    assert_eq!(value(&unit, "RestartPreventExitStatus"), "64");
    assert_eq!(run(["serve", "--listen", "nowhere"]).code, Some(64));
}

/// Where systemd is not there, the test is skipped, loudly.
#[test]
fn systemd_finds_nothing_wrong_with_the_unit() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let path = directory.path().join("scpsfm.service");
    let unit = deployed("scpsfm.service").replace("/usr/local/bin/scpsfm", env!("CARGO_BIN_EXE_scpsfm"));
    fs::write(&path, unit).expect("written");
    let Ok(output) = Command::new("systemd-analyze").args(["verify", "--man=no"]).arg(&path).output() else {
        // Past the capture of a passing test's output.
        writeln!(std::io::stderr(), "SKIPPED the check of the unit: systemd-analyze is missing").expect("stderr");
        return;
    };
    // What it does not know it ignores, with a line that names the file.
    let told = String::from_utf8_lossy(&output.stderr);
    let about_the_unit: Vec<&str> = told.lines().filter(|line| line.contains("scpsfm.service")).collect();
    assert!(about_the_unit.is_empty(), "{about_the_unit:?}");
}
