//! What a run of a sweep is: its scene made, its contestant asked, its answer measured.

use super::plan::Run;
use super::records;
use crate::domain::{Input, Limits, Silent, StopToken};
use crate::solver;
use crate::synthetic::Scene;
use scpsfm_core::evaluation::measures::Measures;
use scpsfm_core::evaluation::oracle;

/// The file of the sweeps' records.
pub const RECORDS: &str = "runs.jsonl";

/// The records of the sweeps.
pub type Records = records::Records<Run, Measures>;

/// One run; `None` when it was stopped.
///
/// # Errors
/// A scene that cannot be made, or a defect of the solver, in words.
pub fn measure(run: &Run, stop: &StopToken) -> Result<Option<Measures>, String> {
    let scene = Scene::generate(&run.scene).map_err(|error| error.to_string())?;
    let Some(settings) = run.settings() else { return Ok(Some(oracle::measure(&scene))) };
    let input = Input::new(scene.input.clone(), &Limits::default(), "scene").map_err(|error| error.to_string())?;
    match solver::solve(&input, &settings, &mut Silent, stop) {
        Ok(solution) => Ok(Some(Measures::of(&scene, &solution))),
        Err(solver::Error::Stopped(_)) => Ok(None),
        Err(error) => Err(error.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::evaluation::plan::Contestant;
    use crate::evaluation::records::Error;
    use crate::synthetic::SceneOptions;

    fn runs(seeds: u64) -> Vec<Run> {
        (0..seeds)
            .flat_map(|seed| {
                let scene =
                    SceneOptions { views: 5, tracks: 40, outliers: 0.3, with_depths: true, seed, ..Default::default() };
                let oracle = Run::oracle(scene);
                [oracle.clone(), Run { contestant: Contestant::Psfm, ..oracle }]
            })
            .collect()
    }

    fn run_on(records: &mut Records, runs: &[Run], stop: &StopToken, told: &mut dyn FnMut()) -> Result<(), Error> {
        records.run(runs, 2, stop, &|run| measure(run, stop), &mut |_| told())
    }

    fn run_all(directory: &Path, seeds: u64) -> usize {
        let mut records = Records::open(directory, RECORDS, "a build").expect("a writable directory");
        let mut done = 0;
        run_on(&mut records, &runs(seeds), &StopToken::default(), &mut || done += 1).expect("runs");
        assert_eq!(records.len(), 2 * seeds as usize);
        done
    }

    #[test]
    fn a_second_evaluation_does_only_what_is_missing() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        assert_eq!(run_all(directory.path(), 2), 4);
        assert_eq!(run_all(directory.path(), 3), 2);
        assert_eq!(run_all(directory.path(), 3), 0);
        // A killed process leaves half a line: its run is done again.
        let path = directory.path().join(RECORDS);
        let text = std::fs::read_to_string(&path).expect("records");
        std::fs::write(&path, &text[..text.len() - 20]).expect("writable");
        assert_eq!(run_all(directory.path(), 3), 1);
        assert_eq!(run_all(directory.path(), 3), 0);
    }

    #[test]
    fn records_of_another_build_and_garbage_are_refused() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        run_all(directory.path(), 1);
        let other = Records::open(directory.path(), RECORDS, "another build");
        assert!(matches!(other, Err(Error::OtherBuild { .. })));
        let path = directory.path().join(RECORDS);
        let records = std::fs::read(&path).expect("records");
        for garbage in [&b"{\"scene\": 3}\n"[..], b"\xff\n"] {
            std::fs::write(&path, [&records, garbage].concat()).expect("writable");
            let refused = Records::open(directory.path(), RECORDS, "a build").err().expect("garbage").to_string();
            assert!(refused.contains("line 4: ") && refused.contains("remove this line"), "{refused}");
        }
        std::fs::write(&path, &records).expect("writable");
        assert_eq!(run_all(directory.path(), 1), 0);
        std::fs::write(&path, "a list of mine\n").expect("writable");
        let refused = Records::open(directory.path(), RECORDS, "a build").err().expect("garbage").to_string();
        assert!(refused.contains("line 1: ") && refused.contains("remove the file"), "{refused}");
    }

    #[test]
    fn two_evaluations_do_not_write_the_same_records() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let first = Records::open(directory.path(), RECORDS, "a build").expect("a writable directory");
        assert!(matches!(Records::open(directory.path(), RECORDS, "a build"), Err(Error::Busy { .. })));
        drop(first);
        assert!(Records::open(directory.path(), RECORDS, "a build").is_ok());
    }

    #[test]
    fn a_stopped_evaluation_ends_and_keeps_what_it_has() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let mut records = Records::open(directory.path(), RECORDS, "a build").expect("a writable directory");
        let stop = StopToken::default();
        let mut done = 0;
        run_on(&mut records, &runs(20), &stop, &mut || {
            done += 1;
            stop.stop(crate::domain::StopReason::Cancelled);
        })
        .expect("stopping is no error");
        assert!(done < 40, "{done}");
        drop(records);
        assert_eq!(Records::open(directory.path(), RECORDS, "a build").expect("records").len(), done);
    }

    #[test]
    fn an_impossible_scene_is_named() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let mut records = Records::open(directory.path(), RECORDS, "a build").expect("a writable directory");
        let mut impossible = runs(1);
        impossible[0].scene.views = 1;
        let error = run_on(&mut records, &impossible, &StopToken::default(), &mut || {}).expect_err("one view");
        assert!(error.to_string().contains("views"), "{error}");
    }
}
