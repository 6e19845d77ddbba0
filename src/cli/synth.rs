//! `scpsfm synth`: the paper's scenes as files.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use super::exit::{Exit, Failure};
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
  scpsfm solve scene/observations.csv --width 1000 --height 1000 --out answer";

/// Make a contaminated scene whose truth is known
///
/// The generator of the paper's section 5.1: points in a box, cameras of one focal length around it, noise, and tracks
/// whose image points are exchanged among each other. Writes observations.csv and truth.json; images are 1000 x 1000 px.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// Directory for observations.csv and truth.json; created
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,

    #[command(flatten)]
    pub scene: SceneArgs,

    /// Also write the projective depths, as a fifth column
    #[arg(long)]
    pub depths: bool,
}

/// The scene's measures; `demo` has them too.
#[derive(Debug, Clone, clap::Args)]
#[command(next_help_heading = "The scene")]
pub struct SceneArgs {
    /// Views (images)
    #[arg(long, default_value_t = 10)]
    pub views: usize,

    /// Tracks; each is seen in every view
    #[arg(long, default_value_t = 200)]
    pub tracks: usize,

    /// Standard deviation of the noise as a share of the image width
    #[arg(long, value_name = "SHARE", default_value_t = 0.003)]
    pub noise: f64,

    /// Share of the tracks that are outliers
    #[arg(long, value_name = "SHARE", default_value_t = 0.9)]
    pub outliers: f64,

    /// Largest rotation about each axis in radians; above 0.5 the cameras orbit the scene
    #[arg(long, value_name = "RAD", default_value_t = 0.4)]
    pub rotation: f64,

    /// Seed of the scene: one seed, one scene
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
}

impl SceneArgs {
    /// The scene itself.
    ///
    /// # Errors
    /// A measure out of range, as wrong usage.
    pub fn generate(&self, with_depths: bool) -> Result<Scene, Failure> {
        let options = SceneOptions {
            views: self.views,
            tracks: self.tracks,
            noise: self.noise,
            outliers: self.outliers,
            max_rotation_rad: self.rotation,
            with_depths,
            seed: self.seed,
        };
        Scene::generate(&options).map_err(Failure::usage)
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
    let scene = args.scene.generate(args.depths)?;
    write_scene(&args.out, &scene)?;
    eprintln!("{}: {}", describe(&scene), args.out.display());
    Ok(Exit::Done)
}

/// The scene in a line.
pub fn describe(scene: &Scene) -> String {
    let right = scene.truth.inlier.iter().filter(|&&inlier| inlier).count();
    format!(
        "{} views, {} tracks of which {right} are right, focal {:.1} px",
        scene.options.views, scene.options.tracks, scene.truth.focal_px
    )
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
    use super::*;
    use crate::domain::{ImageSize, Limits};
    use crate::formats;

    fn scene_args() -> SceneArgs {
        SceneArgs { views: 4, tracks: 30, noise: 0.003, outliers: 0.5, rotation: 0.4, seed: 11 }
    }

    #[test]
    fn what_is_written_reads_back_exactly() {
        for depths in [false, true] {
            let directory = tempfile::tempdir().expect("a temporary directory");
            let out = directory.path().join("new/scene");
            let args = Args { out: out.clone(), scene: scene_args(), depths };
            assert_eq!(run(args), Ok(Exit::Done));
            let size = ImageSize { width_px: IMAGE_SIDE_PX, height_px: IMAGE_SIDE_PX };
            let read = formats::read(&out.join(OBSERVATIONS), &Limits::default(), Some(size)).expect("a valid file");
            let scene = scene_args().generate(depths).expect("valid options");
            assert_eq!(read.raw.views, scene.input.views);
            assert_eq!((&read.raw.view, &read.raw.track), (&scene.input.view, &scene.input.track));
            assert_eq!((&read.raw.x, &read.raw.y), (&scene.input.x, &scene.input.y));
            assert_eq!(read.raw.depth, scene.input.depth);
            assert_eq!(read.raw.depth.is_empty(), !depths);

            let text = std::fs::read_to_string(out.join(TRUTH)).expect("truth.json");
            let truth: serde_json::Value = serde_json::from_str(&text).expect("JSON");
            assert_eq!(truth["focal_px"], scene.truth.focal_px);
            assert_eq!(truth["inlier"].as_array().expect("an array").len(), 30);
            assert_eq!(truth["options"]["seed"], 11);
        }
    }

    #[test]
    fn measures_out_of_range_are_wrong_usage() {
        let failure = SceneArgs { views: 1, ..scene_args() }.generate(false).expect_err("one view");
        assert_eq!(failure.exit, Exit::Usage);
        assert!(failure.message.contains("views"), "{failure}");
    }
}
