//! Python, where a test needs it and it is there.

use std::io::Write;
use std::process::Command;

/// An interpreter that has these modules. Without one the test is skipped, loudly, unless `SCPSFM_REQUIRE_PYTHON`
/// forbids it.
pub fn python(what: &str, modules: &str) -> Option<String> {
    let python = std::env::var("SCPSFM_PYTHON").unwrap_or_else(|_| "python3".into());
    let found = Command::new(&python).args(["-c", &format!("import {modules}")]).output();
    if found.is_ok_and(|output| output.status.success()) {
        return Some(python);
    }
    let missing = format!("{python} with {modules} is missing (SCPSFM_PYTHON names an interpreter)");
    assert!(std::env::var_os("SCPSFM_REQUIRE_PYTHON").is_none(), "{missing}");
    // Past the capture of a passing test's output.
    writeln!(std::io::stderr(), "SKIPPED {what}: {missing}").expect("stderr");
    None
}

/// Runs the interpreter to its end; returns what it printed.
pub fn succeeds(command: &mut Command) -> String {
    let output = command.output().expect("the interpreter runs");
    let text = |bytes| String::from_utf8(bytes).expect("UTF-8");
    let (stdout, stderr) = (text(output.stdout), text(output.stderr));
    assert!(output.status.success(), "{command:?}\n{stdout}\n{stderr}");
    stdout
}
