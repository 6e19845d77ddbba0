//! `scpsfm submit` with several inputs: one call, all jobs or none.

use std::path::Path;

use crate::support::program::{Serving, run};
use crate::support::scrape::Page;

/// A table of so many tracks.
fn table(directory: &Path, tracks: usize) -> String {
    let path = directory.join(format!("{tracks}.csv"));
    let rows: String = (0..2 * tracks).map(|k| format!("{},{},{k},{}\n", k % 2, k / 2, 3 * k)).collect();
    std::fs::write(&path, format!("view,track,x,y\n{rows}")).expect("written");
    path.to_str().expect("a path of ours").to_owned()
}

#[test]
fn several_inputs_are_several_jobs_or_none() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let limits = [("SCPSFM_LIMITS__MAX_TRACKS", "4")];
    let server = Serving::start_with(&directory.path().join("data"), &limits, std::process::Stdio::null());
    let submit = |more: &[&str]| run(["submit", "--method", "geometry", "--server", &server.grpc].iter().chain(more));
    let count = || run(["list", "--server", &server.grpc]).stdout.lines().count();
    let (a, b) = (table(directory.path(), 3), table(directory.path(), 4));

    let both = submit(&[&a, &b, "--request-id", "r", "--label", "of=both"]);
    assert_eq!(both.code, Some(0), "{both:?}");
    let names: Vec<&str> = both.stdout.lines().collect();
    for (name, tracks) in names.iter().zip([3, 4]) {
        let got = run(["get", name, "--server", &server.grpc]);
        let line = got.stdout.lines().next().unwrap_or_default();
        assert!(line.contains(&format!("2 views, {tracks} tracks")) && line.ends_with("  of=both"), "{got:?}");
    }
    assert_eq!(names.len(), 2);
    let again = submit(&[&a, &b, "--request-id", "r", "--label", "of=both"]);
    assert_eq!((again.code, &again.stdout), (Some(0), &both.stdout), "the same ids are the same jobs");
    assert_eq!(count(), 2);

    // One that only the server finds bad: the file is named, and nothing is stored.
    let refused = submit(&[&a, &table(directory.path(), 5)]);
    assert_eq!(refused.code, Some(65), "{refused:?}");
    assert!(refused.stderr.contains("5.csv") && !refused.stderr.contains("3.csv"), "{refused:?}");
    let by_flag = submit(&[&a, &b, "--label", &format!("{}=x", "k".repeat(64))]);
    assert_eq!(by_flag.code, Some(2), "{by_flag:?}");
    assert!(by_flag.stderr.contains("error: --label: ") && !by_flag.stderr.contains(".csv"), "{by_flag:?}");
    for one_only in [&["--watch"][..], &["--job-id", "a"]] {
        let refused = submit(&[&[a.as_str(), b.as_str()], one_only].concat());
        assert_eq!(refused.code, Some(2), "{refused:?}");
        assert!(refused.stderr.contains(one_only[0]), "{refused:?}");
    }
    assert_eq!(count(), 2);

    let upload = |file: &str| run(["upload", file, "--quiet", "--server", &server.grpc]).stdout.trim().to_owned();
    let named = submit(&["--input", &upload(&a), "--input", &upload(&b)]);
    assert_eq!((named.code, named.stdout.lines().count()), (Some(0), 2), "{named:?}");
    assert_eq!(count(), 4);
}

#[test]
fn a_job_that_takes_too_much_memory_is_bad_input_and_names_the_key() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let bounds = [("SCPSFM_ENGINE__MAX_SOLVER_BYTES", "1000000")];
    let server = Serving::start_with(&directory.path().join("data"), &bounds, std::process::Stdio::null());
    let refused = run(["submit", &table(directory.path(), 3), "--server", &server.grpc]);
    assert_eq!(refused.code, Some(65), "{refused:?}");
    assert!(refused.stderr.contains("never fits: engine.max_solver_bytes is 1000000 here"), "{refused:?}");
    assert!(!refused.stderr.contains("try again"), "{refused:?}");
    let page = Page::parse(&server.page("/metrics"));
    let of_job = "scpsfm_admission_refusals_total{reason=\"JOB_TOO_LARGE\",bound=\"solver_bytes\"}";
    assert_eq!((page.value(of_job), page.sum("scpsfm_admission_refusals_total")), (1.0, 1.0));
    let memory = (page.value("scpsfm_solver_capacity_bytes"), page.value("scpsfm_solver_bytes"));
    assert_eq!(memory, (1_000_000.0, 0.0));
}

#[test]
fn what_never_fits_is_bad_input_and_names_the_key() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let bounds = [("SCPSFM_ENGINE__QUEUE_CAPACITY", "1"), ("SCPSFM_UPLOAD__TENANT_BYTES", "20")];
    let server = Serving::start_with(&directory.path().join("data"), &bounds, std::process::Stdio::null());
    let (a, b) = (table(directory.path(), 3), table(directory.path(), 4));
    let batch = run(["submit", &a, &b, "--server", &server.grpc]);
    assert_eq!(batch.code, Some(65), "{batch:?}");
    assert!(batch.stderr.contains("2 jobs in one batch never fit: engine.queue_capacity is 1 here"), "{batch:?}");
    let upload = run(["upload", &a, "--quiet", "--server", &server.grpc]);
    assert_eq!(upload.code, Some(65), "{upload:?}");
    assert!(upload.stderr.contains("upload.tenant_bytes is 20 here"), "{upload:?}");
    for refused in [&batch, &upload] {
        assert!(!refused.stderr.contains("try again"), "{refused:?}");
    }
    let page = Page::parse(&server.page("/metrics"));
    let of_batch = "scpsfm_admission_refusals_total{reason=\"BATCH_TOO_LARGE\",bound=\"jobs\"}";
    assert_eq!((page.value(of_batch), page.sum("scpsfm_admission_refusals_total")), (1.0, 1.0));
    let of_upload = "scpsfm_upload_refusals_total{reason=\"UPLOAD_TOO_LARGE\",bound=\"tenant_upload_bytes\"}";
    assert_eq!((page.value(of_upload), page.sum("scpsfm_upload_refusals_total")), (1.0, 1.0));
}
