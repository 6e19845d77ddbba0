//! `scpsfm synth`: the paper's scenes as files.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use super::exit::{Exit, Failure};
pub use super::scene_args::SceneArgs;
use super::scene_args::{CameraArgs, GeometryArgs, OutlierArgs};
use crate::domain::RawInput;
use crate::formats::result_files::{OBSERVATIONS, create_directory, pretty, write_atomically};
pub use crate::synthetic::scene::IMAGE_SIDE_PX;
use crate::synthetic::{Scene, SceneOptions, Truth};

/// Name of the file that holds what the scene was made of.
pub const TRUTH: &str = "truth.json";

const EXAMPLES: &str = "\
Examples:
  scpsfm synth --out scene
  scpsfm synth --out scene --outliers 0.95 --tracks 400 --seed 3
  scpsfm synth --out scene --motion pure-translation --outliers 0.3   # no method can calibrate this
  scpsfm synth --out scene --wrong-views 2 --second-motion 0.3   # partly wrong tracks, two bodies
  scpsfm solve scene/observations.csv --width 1000 --height 1000 --out answer";

/// Make a contaminated scene whose truth is known
///
/// The generator of the paper's section 5.1: points in a box, cameras of one focal length around it, noise, and tracks
/// whose image points are exchanged among each other; and departures from it, among them motions that no
/// self-calibration survives. Writes observations.csv and truth.json; images are 1000 x 1000 px.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// Directory for observations.csv and truth.json; created
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,

    #[command(flatten)]
    pub scene: SceneArgs,

    #[command(flatten)]
    pub geometry: GeometryArgs,

    #[command(flatten)]
    pub outliers: OutlierArgs,

    #[command(flatten)]
    pub camera: CameraArgs,

    /// Also write the projective depths, as a fifth column
    #[arg(long, help_heading = "The scene")]
    pub depths: bool,
}

impl Args {
    fn generate(&self) -> Result<Scene, Failure> {
        let options = self.geometry.apply(self.scene.options(self.depths));
        Scene::generate(&self.camera.apply(self.outliers.apply(options))).map_err(Failure::usage)
    }
}

/// What truth.json holds.
#[derive(serde::Serialize)]
struct TruthJson<'a> {
    options: &'a SceneOptions,
    image_width_px: u32,
    image_height_px: u32,
    #[serde(flatten)]
    truth: &'a Truth,
}

/// Runs the command.
pub fn run(args: Args) -> Result<Exit, Failure> {
    let scene = args.generate()?;
    write_scene(&args.out, &scene)?;
    eprintln!("{}: {}", describe(&scene), args.out.display());
    Ok(Exit::Done)
}

/// The scene in a line.
pub fn describe(scene: &Scene) -> String {
    let right = scene.truth.inlier.iter().filter(|&&inlier| inlier).count();
    let focal = match scene.options.zoom {
        0.0 => format!("focal {:.1} px", scene.truth.focal_px),
        zoom => format!("focal {:.1} px +- {:.0} %", scene.truth.focal_px, 100.0 * zoom),
    };
    format!("{} views, {} tracks of which {right} are right, {focal}", scene.options.views, scene.options.tracks)
}

/// Writes observations.csv and truth.json.
///
/// # Errors
/// The file that cannot be written.
pub fn write_scene(directory: &Path, scene: &Scene) -> Result<(), Failure> {
    create_directory(directory)?;
    write_atomically(directory, OBSERVATIONS, observations_csv(&scene.input).as_bytes())?;
    let truth = TruthJson {
        options: &scene.options,
        image_width_px: IMAGE_SIDE_PX,
        image_height_px: IMAGE_SIDE_PX,
        truth: &scene.truth,
    };
    write_atomically(directory, TRUTH, pretty(&truth)?.as_bytes())?;
    Ok(())
}

/// `view,track,x,y[,depth]`; every number as short as it reads back exactly.
pub fn observations_csv(input: &RawInput) -> String {
    let has_depths = !input.depth.is_empty();
    let mut text = String::from(if has_depths { "view,track,x,y,depth\n" } else { "view,track,x,y\n" });
    for k in 0..input.x.len() {
        // Writing to a String cannot fail.
        let _ = write!(text, "{},{},{},{}", input.view[k], input.track[k], input.x[k], input.y[k]);
        if has_depths {
            let _ = write!(text, ",{}", input.depth[k]);
        }
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use std::ffi::OsStr;

    use clap::Parser;

    use super::*;
    use crate::domain::{ImageSize, Limits};
    use crate::formats::{self, Reading};
    use crate::synthetic::{Motion, NoiseKind, OutlierKind, Shape};

    /// Parses the arguments of a small scene and these.
    fn args(out: &Path, more: &[&str]) -> Args {
        #[derive(clap::Parser)]
        struct Command {
            #[command(flatten)]
            args: Args,
        }
        let small = ["synth", "--views", "4", "--tracks", "30", "--outliers", "0.5", "--seed", "11", "--out"];
        let arguments = small.iter().map(OsStr::new).chain([out.as_os_str()]).chain(more.iter().map(OsStr::new));
        Command::try_parse_from(arguments).unwrap_or_else(|error| panic!("{error}")).args
    }

    #[test]
    fn what_is_written_reads_back_exactly() {
        for more in [&[][..], &["--depths"]] {
            let directory = tempfile::tempdir().expect("a temporary directory");
            let out = directory.path().join("new/scene");
            let args = args(&out, more);
            let scene = args.generate().expect("valid options");
            assert_eq!(run(args), Ok(Exit::Done));
            let size = ImageSize { width_px: IMAGE_SIDE_PX, height_px: IMAGE_SIDE_PX };
            let reading = Reading { size: Some(size), ..Reading::default() };
            let read = formats::read(&out.join(OBSERVATIONS), &Limits::default(), &reading).expect("a valid file");
            assert_eq!(read.raw.views, scene.input.views);
            assert_eq!((&read.raw.view, &read.raw.track), (&scene.input.view, &scene.input.track));
            assert_eq!((&read.raw.x, &read.raw.y), (&scene.input.x, &scene.input.y));
            assert_eq!(read.raw.depth, scene.input.depth);
            assert_eq!(read.raw.depth.is_empty(), more.is_empty());

            let text = std::fs::read_to_string(out.join(TRUTH)).expect("truth.json");
            let truth: serde_json::Value = serde_json::from_str(&text).expect("JSON");
            assert_eq!(truth["focal_px"], scene.truth.focal_px);
            assert_eq!(truth["inlier"].as_array().expect("an array").len(), 30);
            assert_eq!(truth["options"]["seed"], 11);
        }
    }

    #[test]
    fn without_more_arguments_the_scene_is_the_papers() {
        let options = args(Path::new("out"), &[]).generate().expect("valid options").options;
        let paper = SceneOptions { views: 4, tracks: 30, outliers: 0.5, seed: 11, ..SceneOptions::default() };
        assert_eq!(options, paper);
    }

    #[test]
    fn every_argument_reaches_its_option() {
        let base = args(Path::new("out"), &[]).generate().expect("valid options").options;
        let cases: [(&[&str], SceneOptions); 9] = [
            (&["--shape", "plane"], SceneOptions { shape: Shape::Plane, ..base.clone() }),
            (&["--motion", "pure-rotation"], SceneOptions { motion: Motion::PureRotation, ..base.clone() }),
            (&["--outlier-kind", "slid"], SceneOptions { outlier_kind: OutlierKind::Slid, ..base.clone() }),
            (&["--wrong-views", "2"], SceneOptions { wrong_views: 2, ..base.clone() }),
            (&["--second-motion", "0.3"], SceneOptions { second_motion: 0.3, ..base.clone() }),
            (&["--noise-kind", "heavy"], SceneOptions { noise_kind: NoiseKind::Heavy, ..base.clone() }),
            (&["--principal-point", "-0.05,0.1"], SceneOptions { principal_point: [-0.05, 0.1], ..base.clone() }),
            (&["--radial-k1", "-0.05"], SceneOptions { radial_k1: -0.05, ..base.clone() }),
            (&["--zoom", "0.2"], SceneOptions { zoom: 0.2, ..base.clone() }),
        ];
        for (more, expected) in cases {
            let options = args(Path::new("out"), more).generate().expect("valid options").options;
            assert_eq!(options, expected, "{more:?}");
        }
    }

    #[test]
    fn measures_out_of_range_are_wrong_usage() {
        let failure = args(Path::new("out"), &["--noise", "1.5"]).generate().expect_err("more noise than image");
        assert_eq!(failure.exit, Exit::Usage);
        assert!(failure.message.contains("noise"), "{failure}");
    }
}
