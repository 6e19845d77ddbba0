//! `scpsfm demo`: the whole thing in one command.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};

use serde_json::json;

use super::exit::{Exit, Failure};
use super::interrupt::Interrupt;
use super::next_steps::Files;
use super::progress::ProgressView;
use super::service::Service;
use super::synth::{self, SceneArgs};
use super::{job_view, print, summary};
use crate::client::{Client, Options};
use crate::config::Config;
use crate::domain::job::JobEvent;
use crate::domain::{Solution, SolveSettings};
use crate::formats::LabelledInput;
use crate::formats::publish::pretty;
use crate::formats::result_files;
use crate::formats::result_json::ResultJson;
use crate::synthetic::Scene;
use crate::synthetic::metrics::{Agreement, agreement};

/// Agreement below which the demo has failed: far below what a working build reaches (.99), far above chance (.18 for
/// calling all of 90 % outliers inliers).
const LEAST_F1: f64 = 0.9;

/// Seconds that the demo's server takes to end; its one job has ended by then.
const DRAIN_SECONDS: u64 = 2;

const EXAMPLES: &str = "\
Examples:
  scpsfm demo
  scpsfm demo --seed 3 --outliers 0.95 --tracks 400
  scpsfm demo --json | jq .f1

Files: the result files of `scpsfm solve`, above all report.html, and the scene with its truth in scene/. Ends with \
code 1 when the inliers found agree badly with the truth (F1 below 0.9).";

/// Show the whole thing: make a scene, solve it through a real server, compare with the truth
///
/// Starts the server on a free loopback port with its store in a temporary directory, makes a contaminated scene,
/// submits it over gRPC, shows the progress as it comes, prints what was found beside what is true, and writes a
/// report.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// Directory for the result files; created, files of these names in it are replaced
    #[arg(long, value_name = "DIR", default_value = "scpsfm-demo")]
    pub out: PathBuf,

    #[command(flatten)]
    pub scene: SceneArgs,

    /// Also give the solver the projective depths
    #[arg(long)]
    pub depths: bool,

    /// Print the figures as JSON on stdout, instead of words
    #[arg(long)]
    pub json: bool,

    /// Show no progress and no words
    #[arg(long, short)]
    pub quiet: bool,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    let scene = args.scene.generate(args.depths)?;
    synth::write_scene(&args.out.join("scene"), &scene)?;
    let mut progress = ProgressView::new(args.quiet);
    progress.state(&format!("scene: {}", synth::describe(&scene)));
    let data = tempfile::tempdir()?;
    let service = Service::start(&config(data.path()), std::future::pending()).await?;
    let service = service.ok_or_else(|| Failure::internal("the service was ended before it had started"))?;
    let server = format!("http://{}", service.address());
    progress.state(&format!("server: {server}, store in {}", data.path().display()));
    let interrupt = Interrupt::listen()?;
    let mut on_event = |event: &JobEvent| job_view::show_event(&mut progress, event);
    let settings = SolveSettings::default();
    let outcome = match Client::connect(&server, &Options::default()).await {
        Ok(mut client) => client.solve(&scene.input, &settings, &mut on_event, interrupt.token()).await,
        Err(error) => Err(error),
    };
    progress.finish();
    service.stop(std::future::pending()).await?;
    let solution = outcome?;
    let input = LabelledInput::unlabelled(scene.input.clone(), Path::new(result_files::OBSERVATIONS));
    result_files::write(&args.out, &solution, Some(&input), &[])?;
    let comparison = Comparison::new(&scene, &solution);
    if args.json {
        print(comparison.json(&args, &solution, &input)?.trim_end())?;
    } else if !args.quiet {
        print(comparison.text(&args, &scene, &solution, &input).trim_end())?;
    }
    let finds_that_nothing_is_right = solution.grade.is_none() && !scene.truth.inlier.contains(&true);
    if comparison.inliers.f1 < LEAST_F1 && !finds_that_nothing_is_right {
        let what = format!(
            "the inliers found agree badly with the truth: F1 {:.3} is below {LEAST_F1}",
            comparison.inliers.f1
        );
        return Err(Failure::internal(what));
    }
    Ok(Exit::Done)
}

/// A server for one job.
fn config(data_dir: &Path) -> Config {
    let mut config = Config::default();
    config.server.listen = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
    config.http.listen = None;
    config.store.data_dir = data_dir.into();
    config.engine.workers = 1;
    config.engine.drain_seconds = DRAIN_SECONDS;
    config
}

/// Found against true.
struct Comparison {
    inliers: Agreement,
    focal_px: Option<f64>,
    focal_true_px: f64,
    /// As a share of the true focal length.
    focal_error: Option<f64>,
}

impl Comparison {
    fn new(scene: &Scene, solution: &Solution) -> Self {
        let focal_px = solution.calibrations.first().map(|calibration| calibration.focal_px);
        let focal_true_px = scene.truth.focal_px;
        // An answer for other tracks than were asked for agrees with nothing.
        let found = if solution.tracks.inlier.len() == scene.truth.inlier.len() {
            solution.tracks.inlier.clone()
        } else {
            vec![false; scene.truth.inlier.len()]
        };
        Self {
            inliers: agreement(&found, &scene.truth.inlier),
            focal_px,
            focal_true_px,
            focal_error: focal_px.map(|focal_px| (focal_px / focal_true_px - 1.0).abs()),
        }
    }

    fn text(&self, args: &Args, scene: &Scene, solution: &Solution, input: &LabelledInput) -> String {
        let right = scene.truth.inlier.iter().filter(|&&inlier| inlier).count();
        let mut lines = vec![
            summary::text(solution, Some(input)),
            String::new(),
            format!("  {:<16}{:>12}{:>12}", "", "found", "true"),
        ];
        lines.push(format!(
            "  {:<16}{:>12}{right:>12}   F1 {:.3} (precision {:.3}, recall {:.3})",
            "inlier tracks",
            solution.inlier_track_count(),
            self.inliers.f1,
            self.inliers.precision,
            self.inliers.recall
        ));
        let pixels = |value: f64| format!("{value:.1} px");
        let found = self.focal_px.map_or_else(|| "-".into(), pixels);
        let error = self.focal_error.map_or_else(String::new, |error| format!("   error {:.2} %", error * 100.0));
        lines.push(format!("  {:<16}{found:>12}{:>12}{error}", "focal length", pixels(self.focal_true_px)));
        // The RMS of distances is the noise of two coordinates.
        let noise_px = scene.options.noise * f64::from(synth::IMAGE_SIDE_PX) * std::f64::consts::SQRT_2;
        let rms = solution.reprojection_rms_px.map_or_else(|| "-".into(), |px| format!("{px:.2} px"));
        lines.push(format!("  {:<16}{rms:>12}{:>12}", "reprojection RMS", format!("{noise_px:.2} px")));
        let files = Files { directory: &args.out, exports: &[], format: None };
        lines.push(format!("\n{}", summary::next(solution, &files)));
        lines.join("\n")
    }

    fn json(&self, args: &Args, solution: &Solution, input: &LabelledInput) -> Result<String, Failure> {
        let value = json!({
            "seed": args.scene.seed,
            "f1": self.inliers.f1,
            "precision": self.inliers.precision,
            "recall": self.inliers.recall,
            "focal_true_px": self.focal_true_px,
            "focal_error": self.focal_error,
            "result": ResultJson::new(solution, Some(input)),
        });
        Ok(pretty(&value)?)
    }
}
