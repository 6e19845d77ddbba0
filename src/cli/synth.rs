//! `scpsfm synth`: the paper's scenes as files.

use std::path::{Path, PathBuf};

use super::args::parse_whole;
use super::exit::{Exit, Failure};
pub use super::scene_args::SceneArgs;
use super::scene_args::{CameraArgs, GeometryArgs, OutlierArgs};
use crate::domain::error::quoted;
use crate::domain::{ImageSize, RawInput, counted};
use crate::formats::publish::{create_directory, pretty, write_atomically};
use crate::formats::result_files::OBSERVATIONS;
use crate::formats::{observations, view_table};
use crate::synthetic::photographed::IMAGE_SIZE;
pub use crate::synthetic::scene::IMAGE_SIDE_PX;
use crate::synthetic::{Photographed, PhotographedOptions, Scene, Sequence, SequenceOptions};

/// Size of the images of all scenes but the photographed ones.
const SQUARE: ImageSize = ImageSize { width_px: IMAGE_SIDE_PX, height_px: IMAGE_SIDE_PX };
/// Name of the file that holds what the scene was made of.
pub const TRUTH: &str = "truth.json";
/// Name of the table of views.
pub const VIEWS: &str = "views.csv";

const EXAMPLES: &str = "\
Examples:
  scpsfm synth --out scene
  scpsfm synth --out scene --outliers 0.95 --tracks 400 --seed 3
  scpsfm synth --out scene --motion pure-translation --outliers 0.3   # no method can calibrate this
  scpsfm synth --out scene --wrong-views 2 --second-motion 0.3   # partly wrong tracks, two bodies
  scpsfm synth --out scene --outliers 0.3 --wrong-observations 2   # right tracks that are wrong in 2 of 10 views
  scpsfm synth --out walk --sequence --views 100 --tracks 5000 --noise 0.0005 --outliers 0.5   # tracks of 3 to 10 views
  scpsfm synth --out photographed --photographed --seed 7   # truth.json says what was drawn
  scpsfm solve photographed/observations.csv --view-table photographed/views.csv --out answer
  scpsfm solve scene/observations.csv --width 1000 --height 1000 --out answer";

/// Make a contaminated scene whose truth is known
///
/// The generator of the paper's section 5.1: points in a box, cameras of one focal length around it, noise, and tracks
/// whose image points are exchanged among each other; and departures from it, among them motions that no
/// self-calibration survives. Writes observations.csv, views.csv and truth.json; images are 1000 x 1000 px, and points
/// are where the cameras project them, many of them outside; those of --photographed are inside, of 1600 x 1200 px.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// Directory for observations.csv, views.csv (camera group and size of each view) and truth.json; created
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

    #[command(flatten)]
    pub sequence: SequenceArgs,

    /// A scene as people photograph it, all of whose choices (motion, lens, focal lengths, visible views, noise, what
    /// is wrong) are drawn from --seed; images are 1600 x 1200 px. truth.json holds the choices and the camera group of
    /// each view
    #[arg(long, help_heading = "A photographed scene", conflicts_with_all = ["views", "tracks", "noise", "outliers",
        "rotation", "shape", "motion", "roll", "outlier_kind", "wrong_views", "seen_views", "wrong_observations",
        "deleted_observations", "second_motion", "noise_kind", "principal_point", "radial_k1", "focal_px", "zoom",
        "depths", "sequence"])]
    pub photographed: bool,
}

/// A camera that travels, instead of the paper's scene.
#[derive(Debug, Clone, clap::Args)]
#[command(next_help_heading = "A sequence")]
pub struct SequenceArgs {
    /// A camera that travels, whose tracks live a few views each; of the scene's options, --views, --tracks, --noise,
    /// --outliers, --radial-k1, --focal-px, --zoom and --seed apply
    #[arg(long, conflicts_with_all = ["depths", "shape", "motion", "outlier_kind", "wrong_views", "seen_views", "wrong_observations",
        "deleted_observations", "second_motion", "noise_kind", "principal_point", "rotation", "roll"])]
    pub sequence: bool,

    /// Views that a track lives, at least and at most [default: 3,10; of fewer than 10 views all: 3,VIEWS]
    #[arg(long, value_name = "LEAST,MOST", value_parser = lifetime, requires = "sequence")]
    pub lifetime: Option<(usize, usize)>,

    /// Share of the observations of right tracks that are wrong
    #[arg(long, value_name = "SHARE", default_value_t = 0.05, requires = "sequence")]
    pub wrong_share: f64,

    /// Share of the right tracks of six views or more that go over to another point on their way
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, requires = "sequence")]
    pub joined: f64,

    /// The focal length grows steadily over its range, f (1 +- SHARE of --zoom), instead of at random
    #[arg(long, requires_all = ["sequence", "zoom"])]
    pub ramp: bool,

    /// Views, the first ones, in which the camera does not turn; where it never turns, nothing can be calibrated
    #[arg(long, value_name = "VIEWS", default_value_t = 0, requires = "sequence",
        value_parser = parse_whole::<usize>)]
    pub straight: usize,
}

/// Reads two counts with a comma between them.
fn lifetime(text: &str) -> Result<(usize, usize), String> {
    let number = |text: &str| text.trim().parse::<usize>().map_err(|error| format!("{error} in {}", quoted(text)));
    let (least, most) = text.split_once(',').ok_or("two numbers with a comma between them are expected")?;
    Ok((number(least)?, number(most)?))
}

impl Args {
    fn generate(&self) -> Result<Scene, Failure> {
        let options = self.geometry.apply(self.scene.options(self.depths));
        Scene::generate(&self.camera.apply(self.outliers.apply(options))).map_err(|invalid| Failure::of_flags(&invalid))
    }

    fn generate_sequence(&self) -> Result<Sequence, Failure> {
        let options = SequenceOptions {
            views: self.scene.views,
            tracks: self.scene.tracks,
            lifetime: self.sequence.lifetime.unwrap_or_else(|| SequenceOptions::lifetime_within(self.scene.views)),
            noise: self.scene.noise,
            outliers: self.scene.outliers,
            wrong_share: self.sequence.wrong_share,
            joined: self.sequence.joined,
            radial_k1: self.camera.radial_k1,
            focal_range_px: self.camera.focal_range_px(),
            zoom: self.camera.zoom,
            ramp: self.sequence.ramp,
            straight: self.sequence.straight,
            seed: self.scene.seed,
        };
        Sequence::generate(&options).map_err(|invalid| Failure::of_flags(&invalid))
    }
}

/// What truth.json holds.
#[derive(serde::Serialize)]
struct TruthJson<'a, O, T> {
    options: &'a O,
    image_width_px: u32,
    image_height_px: u32,
    #[serde(flatten)]
    truth: &'a T,
}

/// Runs the command.
pub fn run(args: Args) -> Result<Exit, Failure> {
    if args.photographed {
        return photographed(&args);
    }
    if args.sequence.sequence {
        let sequence = args.generate_sequence()?;
        write(&args.out, SQUARE, &sequence.input, &sequence.options, &sequence.truth)?;
        let right = sequence.truth.inlier.iter().filter(|&&inlier| inlier).count();
        tell!(
            "{}, {}, {} of {} to {} of which {right} are right, {}: {}",
            counted(args.scene.views, "view"),
            counted(sequence.input.x.len(), "observation"),
            counted(args.scene.tracks, "track"),
            sequence.options.lifetime.0,
            counted(sequence.options.lifetime.1, "view"),
            focal(sequence.truth.focal_px, sequence.options.zoom),
            args.out.display()
        );
        return Ok(Exit::Done);
    }
    let scene = args.generate()?;
    write_scene(&args.out, &scene)?;
    tell!("{}: {}", describe(&scene), args.out.display());
    Ok(Exit::Done)
}

/// Writes the photographed scene of the seed.
fn photographed(args: &Args) -> Result<Exit, Failure> {
    let options = PhotographedOptions::drawn(args.scene.seed);
    let scene = Photographed::generate(&options).map_err(|error| Failure::usage(format!("--seed: {error}")))?;
    write(&args.out, IMAGE_SIZE, &scene.input, &scene.options, &scene.truth)?;
    let right = scene.truth.inlier.iter().filter(|&&inlier| inlier).count();
    tell!(
        "{}: {}, {}, {} of which {right} are right, {}: {}",
        options.name(),
        counted(options.views, "view"),
        counted(scene.input.x.len(), "observation"),
        counted(options.tracks, "track"),
        focal(options.focal_px, 0.0),
        args.out.display()
    );
    Ok(Exit::Done)
}

/// The scene in a line.
pub fn describe(scene: &Scene) -> String {
    let right = scene.truth.inlier.iter().filter(|&&inlier| inlier).count();
    let focal = focal(scene.truth.focal_px, scene.options.zoom);
    let (views, tracks) = (counted(scene.options.views, "view"), counted(scene.options.tracks, "track"));
    format!("{views}, {tracks} of which {right} are right, {focal}")
}

/// The focal length of a scene in words.
fn focal(focal_px: f64, zoom: f64) -> String {
    match zoom {
        0.0 => format!("focal {focal_px:.1} px"),
        zoom => format!("focal {focal_px:.1} px +- {:.0} %", 100.0 * zoom),
    }
}

/// Writes observations.csv, views.csv and truth.json.
///
/// # Errors
/// The file that cannot be written.
pub fn write_scene(directory: &Path, scene: &Scene) -> Result<(), Failure> {
    write(directory, SQUARE, &scene.input, &scene.options, &scene.truth)
}

fn write<O: serde::Serialize, T: serde::Serialize>(
    directory: &Path,
    size: ImageSize,
    input: &RawInput,
    options: &O,
    truth: &T,
) -> Result<(), Failure> {
    create_directory(directory)?;
    write_atomically(directory, OBSERVATIONS, observations::csv(input).as_bytes())?;
    write_atomically(directory, VIEWS, view_table::csv(input).as_bytes())?;
    let truth = TruthJson { options, image_width_px: size.width_px, image_height_px: size.height_px, truth };
    write_atomically(directory, TRUTH, pretty(&truth)?.as_bytes())?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::ffi::OsStr;

    use clap::Parser;

    use super::*;
    use crate::domain::Limits;
    use crate::formats::{self, Reading};
    use crate::synthetic::{Motion, NoiseKind, OutlierKind, SceneOptions, Shape};

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
            let reading = Reading { view_table: Some(out.join(VIEWS)), ..Reading::default() };
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

    /// The fields that docs/results.md lists for truth.json: by name, what they are of and which scenes have them.
    fn documented_fields() -> Vec<(String, String, String)> {
        let section = include_str!("../../docs/results.md").split("## `truth.json`").nth(1).expect("a section");
        let rows = section.split("\n## ").next().expect("its text").lines().filter(|line| line.starts_with("| `"));
        let of_row = |row: &str| {
            let cells: Vec<String> = row.split('|').map(|cell| cell.trim().to_owned()).collect();
            let names = cells[1].split(", ").map(|name| name.trim_matches('`').to_owned());
            names.map(|name| (name, cells[2].clone(), cells[3].clone())).collect::<Vec<_>>()
        };
        rows.flat_map(of_row).collect()
    }

    #[test]
    fn the_fields_of_the_truth_are_those_of_the_documentation() {
        let documented = documented_fields();
        for kind in ["paper", "sequence", "photographed"] {
            let directory = tempfile::tempdir().expect("a temporary directory");
            let args = args(directory.path(), &[]);
            let sequence = SequenceArgs { sequence: kind == "sequence", ..args.sequence };
            assert_eq!(run(Args { sequence, photographed: kind == "photographed", ..args }), Ok(Exit::Done));
            let text = std::fs::read(directory.path().join(TRUTH)).expect("truth.json");
            let truth: serde_json::Value = serde_json::from_slice(&text).expect("JSON");
            let truth = truth.as_object().expect("an object");
            let reading = Reading { view_table: Some(directory.path().join(VIEWS)), ..Reading::default() };
            let read = formats::read(&directory.path().join(OBSERVATIONS), &Limits::default(), &reading);
            let raw = read.expect("a valid file").raw;
            let here =
                documented.iter().filter(|(_, _, scenes)| scenes == "all" || scenes.split(", ").any(|of| of == kind));
            let expected: BTreeSet<&str> = here.clone().map(|(name, _, _)| name.as_str()).collect();
            assert_eq!(truth.keys().map(String::as_str).collect::<BTreeSet<_>>(), expected, "{kind}");
            for (name, of, _) in here {
                let count = match of.as_str() {
                    "view" => raw.views.len(),
                    "track" => raw.track_count,
                    "observation" => raw.x.len(),
                    _ => continue,
                };
                assert_eq!(truth[name].as_array().map(Vec::len), Some(count), "{kind}: {name}");
            }
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
        let cases: [(&[&str], SceneOptions); 16] = [
            (&["--shape", "plane"], SceneOptions { shape: Shape::Plane, ..base.clone() }),
            (&["--motion", "pure-rotation"], SceneOptions { motion: Motion::PureRotation, ..base.clone() }),
            (&["--motion", "sphere"], SceneOptions { motion: Motion::Sphere, ..base.clone() }),
            (&["--roll", "1.5"], SceneOptions { max_roll_rad: 1.5, ..base.clone() }),
            (&["--outlier-kind", "slid"], SceneOptions { outlier_kind: OutlierKind::Slid, ..base.clone() }),
            (&["--wrong-views", "2"], SceneOptions { wrong_views: 2, ..base.clone() }),
            (&["--motion", "grid"], SceneOptions { motion: Motion::Grid, ..base.clone() }),
            (&["--seen-views", "3"], SceneOptions { seen_views: 3, ..base.clone() }),
            (&["--wrong-observations", "1"], SceneOptions { wrong_observations: 1, ..base.clone() }),
            (&["--deleted-observations", "1"], SceneOptions { deleted_observations: 1, ..base.clone() }),
            (&["--second-motion", "0.3"], SceneOptions { second_motion: 0.3, ..base.clone() }),
            (&["--noise-kind", "heavy"], SceneOptions { noise_kind: NoiseKind::Heavy, ..base.clone() }),
            (&["--principal-point", "-0.05,0.1"], SceneOptions { principal_point: [-0.05, 0.1], ..base.clone() }),
            (&["--radial-k1", "-0.05"], SceneOptions { radial_k1: -0.05, ..base.clone() }),
            (&["--focal-px", "640"], SceneOptions { focal_range_px: (640.0, 640.0), ..base.clone() }),
            (&["--zoom", "0.2"], SceneOptions { zoom: 0.2, ..base.clone() }),
        ];
        for (more, expected) in cases {
            let options = args(Path::new("out"), more).generate().expect("valid options").options;
            assert_eq!(options, expected, "{more:?}");
        }
    }

    #[test]
    fn a_focal_length_that_is_given_changes_nothing_else() {
        let truth = |more: &[&str]| args(Path::new("out"), more).generate().expect("valid options").truth;
        let (drawn, given) = (truth(&[]), truth(&["--focal-px", "640"]));
        assert_eq!((given.focal_px, &given.focals_px), (640.0, &vec![640.0; 4]));
        assert_eq!(
            (given.points, given.rotations, given.translations, given.inlier),
            (drawn.points, drawn.rotations, drawn.translations, drawn.inlier)
        );
        let sequence = args(Path::new("out"), &["--sequence", "--focal-px", "640"]).generate_sequence();
        assert_eq!(sequence.expect("valid options").truth.focal_px, 640.0);
    }

    #[test]
    fn measures_out_of_range_are_wrong_usage() {
        let failure = args(Path::new("out"), &["--noise", "1.5"]).generate().expect_err("more noise than image");
        assert_eq!(failure.exit, Exit::Usage);
        assert!(failure.message.contains("noise"), "{failure}");
    }

    #[test]
    fn a_photographed_scene_is_written_and_its_choices_are_the_seeds() {
        #[derive(Debug, clap::Parser)]
        struct Command {
            #[command(flatten)]
            args: Args,
        }
        let directory = tempfile::tempdir().expect("a temporary directory");
        let base = ["synth", "--photographed", "--seed", "5", "--out"].map(OsStr::new).to_vec();
        let base = [base, vec![directory.path().as_os_str()]].concat();
        let args = Command::try_parse_from(&base).expect("valid arguments").args;
        assert_eq!(run(args), Ok(Exit::Done));
        let text = std::fs::read_to_string(directory.path().join(TRUTH)).expect("truth.json");
        let truth: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        let options = PhotographedOptions::drawn(5);
        assert_eq!(truth["options"], serde_json::to_value(&options).expect("plain data"));
        assert_eq!((truth["image_width_px"].as_u64(), truth["image_height_px"].as_u64()), (Some(1600), Some(1200)));
        assert_eq!(truth["camera_groups"].as_array().map(Vec::len), Some(options.views));
        for other in [&["--views", "5"][..], &["--sequence"], &["--radial-k1", "0.1"], &["--focal-px", "640"]] {
            let arguments = [base.clone(), other.iter().map(OsStr::new).collect()].concat();
            let error = Command::try_parse_from(arguments).expect_err("the seed draws it");
            assert!(error.to_string().contains("--photographed"), "{error}");
        }
    }
}
