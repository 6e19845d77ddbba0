//! The other program's side. It is called as `COMMAND observations.csv WIDTH HEIGHT -o FILE` and writes a JSON object:
//!
//! * `views`: how many it registered, in one reconstruction
//! * `focal`: in pixels, or null
//! * `inlier`: 0 or 1 for each track id from 0 on; or `observation_inlier`: the same for each line of its input
//! * where it has them: `sigma_log_focal`, `k1`, `reproj` (mean) and `rms` in pixels, `grade`, `warnings` (texts),
//!   `centres` (`[x, y, z]` or null for each view id from 0 on), `error` (a text, beside an empty answer),
//!   `observations` (`[view, track]` of those that it kept; used by `--observations` only)

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus};

use nalgebra::Vector3;
use serde::Deserialize;
use serde_json::Value;

use super::Sequence;
use super::measures::{Answer, Verdicts};
use crate::domain::{ImageSize, counted};
use crate::formats::json;

/// Bytes of an answer: verdicts and centres of the largest input take less than half.
const MOST_BYTES: u64 = 1 << 28;

/// The peer's call for observations; it writes to [`file`] of `scratch`.
pub fn command(words: &[String], observations: &Path, size: ImageSize, scratch: &Path) -> Command {
    let (program, arguments) = words.split_first().map_or(("", &[][..]), |(first, rest)| (first.as_str(), rest));
    let mut command = Command::new(program);
    command.args(arguments).arg(observations);
    command.args([size.width_px.to_string(), size.height_px.to_string()]);
    command.arg("-o").arg(file(scratch));
    command
}

/// Where the peer writes.
pub fn file(scratch: &Path) -> PathBuf {
    scratch.join("peer.json")
}

/// A verdict: peers write 0 and 1, or false and true.
#[derive(Deserialize)]
#[serde(untagged)]
enum Verdict {
    Said(bool),
    Number(f64),
}

impl Verdict {
    fn holds(&self) -> bool {
        match self {
            Verdict::Said(holds) => *holds,
            Verdict::Number(number) => *number != 0.0,
        }
    }
}

/// What a peer writes.
#[derive(Deserialize)]
pub struct PeerFile {
    pub views: usize,
    #[serde(default, deserialize_with = "json::positive")]
    pub focal: Option<f64>,
    inlier: Option<Vec<Verdict>>,
    observation_inlier: Option<Vec<Verdict>>,
    /// View and track of the observations that it kept.
    pub observations: Option<Vec<[u64; 2]>>,
    #[serde(default, deserialize_with = "json::not_negative")]
    pub sigma_log_focal: Option<f64>,
    k1: Option<f64>,
    #[serde(default, deserialize_with = "json::not_negative")]
    reproj: Option<f64>,
    #[serde(default, deserialize_with = "json::not_negative")]
    rms: Option<f64>,
    grade: Option<String>,
    #[serde(default)]
    warnings: Vec<String>,
    centres: Option<Vec<Option<[f64; 3]>>>,
    error: Option<Value>,
}

impl PeerFile {
    /// The verdict on a track; `None`: there is none.
    pub fn keeps_track(&self, track: usize) -> Option<bool> {
        self.inlier.as_ref()?.get(track).map(Verdict::holds)
    }

    /// The verdict on an observation of the input by its place; `None`: there is none.
    pub fn keeps_observation(&self, place: usize) -> Option<bool> {
        self.observation_inlier.as_ref()?.get(place).map(Verdict::holds)
    }
}

/// Reads what a peer wrote that ended with `status`.
///
/// # Errors
/// Why there is no answer, in a sentence.
pub fn read(scratch: &Path, status: ExitStatus, complaint: &str) -> Result<PeerFile, String> {
    if !status.success() {
        return Err(format!("ended with {status}: {complaint}"));
    }
    let file = file(scratch);
    let length = fs::metadata(&file).map_err(|_| format!("wrote no answer: {complaint}"))?.len();
    if length > MOST_BYTES {
        return Err(format!("its answer has {length} bytes, more than {MOST_BYTES}"));
    }
    let text = fs::read(&file).map_err(|error| format!("its answer cannot be read: {error}"))?;
    json::read(&text).map_err(|error| format!("its answer cannot be read: {error}"))
}

/// The answer of a peer that ended with `status`.
///
/// # Errors
/// Why there is no answer, in a sentence.
pub fn answer(sequence: &Sequence, scratch: &Path, status: ExitStatus, complaint: &str) -> Result<Answer, String> {
    let said = read(scratch, status, complaint)?;
    let views = sequence.input.raw.views.len();
    if said.views > views {
        return Err(format!("its answer's `views` is {}, of a sequence of {}", said.views, counted(views, "view")));
    }
    let (inlier, verdicts) = spread(sequence, &said)?;
    let mut warnings = said.warnings;
    match said.error {
        None | Some(Value::Null) => {}
        Some(Value::String(text)) => warnings.push(text),
        Some(other) => warnings.push(other.to_string()),
    }
    let centres = said.centres.unwrap_or_default().into_iter().zip(0u64..);
    Ok(Answer {
        registered: said.views,
        parts: usize::from(said.views > 0),
        grade: said.grade,
        focal_px: said.focal,
        sigma_log_focal: said.sigma_log_focal.filter(|&sigma| sigma > 0.0),
        radial_k1: said.k1,
        inlier,
        verdicts,
        mean_px: said.reproj,
        rms_px: said.rms,
        centres: centres.filter_map(|(centre, view)| Some((view, Vector3::from(centre?)))).collect::<BTreeMap<_, _>>(),
        warnings,
    })
}

/// A verdict on each observation: the peer's own, or its track's.
fn spread(sequence: &Sequence, said: &PeerFile) -> Result<(Vec<bool>, Verdicts), String> {
    let observations = sequence.inlier.len();
    if let Some(verdicts) = &said.observation_inlier {
        if verdicts.len() != observations {
            let what = "`observation_inlier` has";
            let (entries, due) = (counted(verdicts.len(), "entry"), counted(observations, "observation"));
            return Err(format!("its answer's {what} {entries} for {due}"));
        }
        return Ok((verdicts.iter().map(Verdict::holds).collect(), Verdicts::Observations));
    }
    let tracks = said.inlier.as_ref().ok_or("its answer has neither `inlier` nor `observation_inlier`")?;
    let verdict = |k: usize| {
        let (_, track) = sequence.ids(k);
        usize::try_from(track).ok().and_then(|track| tracks.get(track)).map(Verdict::holds).ok_or_else(|| {
            format!("its answer's `inlier` has {}, none for track {track}", counted(tracks.len(), "entry"))
        })
    };
    Ok(((0..observations).map(verdict).collect::<Result<_, _>>()?, Verdicts::Tracks))
}
