//! What is run: ways of giving depths, contestants, and which of them on which sweeps.

use serde::{Deserialize, Serialize};

use super::records;
use super::sweeps::Sweep;
use crate::domain::{Method, Proposal, SolveSettings};
use crate::synthetic::SceneOptions;

scpsfm_core::named! {
    /// How projective depths come to the contestants.
    #[derive(PartialOrd, Ord)]
    pub enum Depths {
        /// True up to noise, as in the paper's synthetic experiments.
        Given = "given",
        /// None: image points alone, as real tracks come.
        None = "none",
        /// None given; the contestants estimate them from fundamental matrices and epipoles (Sturm & Triggs 1996), as
        /// the paper does on real tracks. The scenes are those of [`Depths::None`].
        Epipolar = "epipolar",
    }
}

/// Who answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Contestant {
    /// The truth classifies, metric bundle adjustment of the true inliers calibrates: the best anyone can do.
    Oracle,
    Auto,
    Geometry,
    /// The paper's network under its objective as printed, with the DAQ loss.
    Paper,
    /// The same without it.
    PaperWithoutDaq,
    /// The paper's network by itself under a continued objective.
    Scpsfm,
    /// The same without the DAQ term.
    ScpsfmWithoutDaq,
    /// Plain projective factorisation (Sturm & Triggs 1996) at the threshold that suits the scene best.
    Psfm,
    /// AUTO with the DAQ residual in neither losses nor scores.
    AutoWithoutDaq,
    AutoWithoutIrls,
    AutoWithoutConsistency,
    AutoWithoutRigidity,
    AutoWithoutUniform,
    /// AUTO without the network that was trained beforehand.
    AutoWithoutLearned,
    /// AUTO with the prior of the paper's network and no other.
    NetworkAlone,
    /// AUTO with the prior of the network that was trained beforehand and no other.
    LearnedAlone,
}

impl Contestant {
    /// AUTO and what is left of it: without both networks it is GEOMETRY.
    pub const ABLATION: [Contestant; 10] = [
        Contestant::Auto,
        Contestant::Geometry,
        Contestant::AutoWithoutDaq,
        Contestant::AutoWithoutIrls,
        Contestant::AutoWithoutConsistency,
        Contestant::AutoWithoutRigidity,
        Contestant::AutoWithoutUniform,
        Contestant::AutoWithoutLearned,
        Contestant::NetworkAlone,
        Contestant::LearnedAlone,
    ];
    /// The contestants of the paper's figure.
    pub const ALL: [Contestant; 8] = [
        Contestant::Oracle,
        Contestant::Auto,
        Contestant::Geometry,
        Contestant::Paper,
        Contestant::PaperWithoutDaq,
        Contestant::Scpsfm,
        Contestant::ScpsfmWithoutDaq,
        Contestant::Psfm,
    ];

    /// Its name, its method (the oracle has none), whether it has the DAQ loss, and the proposals that it does without.
    fn definition(self) -> (&'static str, Option<Method>, bool, Vec<Proposal>) {
        match self {
            Self::Oracle => ("oracle", None, true, vec![]),
            Self::Auto => ("auto", Some(Method::Auto), true, vec![]),
            Self::Geometry => ("geometry", Some(Method::Geometry), true, vec![]),
            Self::Paper => ("paper", Some(Method::Paper), true, vec![]),
            Self::PaperWithoutDaq => ("paper-without-daq", Some(Method::Paper), false, vec![]),
            Self::Scpsfm => ("scpsfm", Some(Method::Scpsfm), true, vec![]),
            Self::ScpsfmWithoutDaq => ("scpsfm-without-daq", Some(Method::Scpsfm), false, vec![]),
            Self::Psfm => ("psfm", Some(Method::Psfm), true, vec![]),
            Self::AutoWithoutDaq => ("auto-without-daq", Some(Method::Auto), false, vec![]),
            Self::AutoWithoutIrls => ("auto-without-irls", Some(Method::Auto), true, vec![Proposal::Irls]),
            Self::AutoWithoutConsistency => {
                ("auto-without-consistency", Some(Method::Auto), true, vec![Proposal::Consistency])
            }
            Self::AutoWithoutRigidity => ("auto-without-rigidity", Some(Method::Auto), true, vec![Proposal::Rigidity]),
            Self::AutoWithoutUniform => ("auto-without-uniform", Some(Method::Auto), true, vec![Proposal::Uniform]),
            Self::AutoWithoutLearned => ("auto-without-learned", Some(Method::Auto), true, vec![Proposal::Learned]),
            Self::NetworkAlone => ("network-alone", Some(Method::Auto), true, all_but(Proposal::Network)),
            Self::LearnedAlone => ("learned-alone", Some(Method::Auto), true, all_but(Proposal::Learned)),
        }
    }

    pub fn name(self) -> &'static str {
        self.definition().0
    }

    /// Whether this contestant has anything to say of such a scene: the oracle knows pinholes only, rigidity needs
    /// depths, and epipolar ones are made use of by PAPER, SCPSFM and PSFM alone.
    pub fn takes_part(self, scene: &SceneOptions, depths: Depths) -> bool {
        if depths == Depths::Epipolar && !self.is_paper() && self != Contestant::Psfm {
            return false;
        }
        match self {
            Contestant::Oracle => scene.radial_k1 == 0.0 && scene.zoom == 0.0,
            Contestant::AutoWithoutRigidity => depths == Depths::Given,
            _ => true,
        }
    }

    /// Whether its answer is that of the paper's network, whose width is the evaluation's to choose.
    fn is_paper(self) -> bool {
        use Contestant::{Paper, PaperWithoutDaq, Scpsfm, ScpsfmWithoutDaq};
        matches!(self, Paper | PaperWithoutDaq | Scpsfm | ScpsfmWithoutDaq)
    }
}

fn all_but(one: Proposal) -> Vec<Proposal> {
    Proposal::ALL.into_iter().filter(|&prior| prior != one).collect()
}

/// One scene given to one contestant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Run {
    /// The scene, its seed and whether depths are given included.
    pub scene: SceneOptions,
    pub contestant: Contestant,
    /// Whether it estimates depths from epipolar geometry.
    #[serde(default)]
    pub epipolar_depths: bool,
    /// Width of the network of the PAPER and SCPSFM contestants, as a share of the original; `None` for the others.
    #[serde(default)]
    pub paper_width: Option<f64>,
}

impl Run {
    /// The oracle on a scene.
    pub fn oracle(scene: SceneOptions) -> Self {
        Self { scene, contestant: Contestant::Oracle, epipolar_depths: false, paper_width: None }
    }

    /// The settings that the contestant solves with; `None` for the oracle, which does not solve.
    pub fn settings(&self) -> Option<SolveSettings> {
        let (_, method, use_daq, excluded_proposals) = self.contestant.definition();
        Some(SolveSettings {
            excluded_proposals,
            use_daq,
            seed: self.scene.seed,
            epipolar_depths: self.epipolar_depths,
            network_width: self.paper_width.unwrap_or(SolveSettings::DEFAULT_NETWORK_WIDTH),
            ..SolveSettings::of_method(method?)
        })
    }

    /// What makes a run the same as another: its own text.
    pub fn key(&self) -> String {
        records::key(self)
    }
}

/// Which part of everything is run.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    pub sweeps: Vec<Sweep>,
    pub depths: Vec<Depths>,
    pub contestants: Vec<Contestant>,
    pub seeds: u64,
    /// Width of the network of the PAPER and SCPSFM contestants, as a share of the original.
    pub paper_width: f64,
}

impl Plan {
    /// The contestants that take part on a scene with depths of this kind.
    pub fn contestants_with(&self, scene: &SceneOptions, depths: Depths) -> impl Iterator<Item = Contestant> {
        let part = |contestant: &&Contestant| contestant.takes_part(scene, depths);
        self.contestants.iter().filter(part).copied().collect::<Vec<_>>().into_iter()
    }

    /// The run of a contestant on the scene of a cell with this number.
    pub fn run(&self, scene: &SceneOptions, depths: Depths, number: u64, contestant: Contestant) -> Run {
        Run {
            scene: cell_scene(scene, depths, number),
            contestant,
            epipolar_depths: depths == Depths::Epipolar,
            paper_width: contestant.is_paper().then_some(self.paper_width),
        }
    }

    /// Every run once, seed by seed, so that a stopped evaluation has all cells with fewer seeds.
    pub fn runs(&self) -> Vec<Run> {
        let mut seen = std::collections::HashSet::new();
        let mut runs = Vec::new();
        for seed in 0..self.seeds {
            for sweep in &self.sweeps {
                for &depths in &self.depths {
                    for (_, scene) in &sweep.cells {
                        for contestant in self.contestants_with(scene, depths) {
                            let run = self.run(scene, depths, seed, contestant);
                            if seen.insert(run.key()) {
                                runs.push(run);
                            }
                        }
                    }
                }
            }
        }
        runs
    }
}

/// First seed of the evaluation's scenes: apart from the small ones that tests and demos use.
const FIRST_SEED: u64 = 10_000;

/// The scene of a cell with this number.
pub fn cell_scene(scene: &SceneOptions, depths: Depths, number: u64) -> SceneOptions {
    SceneOptions { with_depths: depths == Depths::Given, seed: FIRST_SEED + number, ..scene.clone() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_that_sweeps_share_are_run_once() {
        let plan = Plan {
            sweeps: Sweep::paper(),
            depths: Depths::ALL.to_vec(),
            contestants: vec![Contestant::Oracle, Contestant::Auto],
            seeds: 2,
            paper_width: SolveSettings::DEFAULT_NETWORK_WIDTH,
        };
        let runs = plan.runs();
        let cells: usize = plan.sweeps.iter().map(|sweep| sweep.cells.len()).sum();
        // The centre of all sweeps (90 % outliers, .3 % noise) is in two. Neither contestant asks for epipolar depths.
        assert_eq!(runs.len(), (cells - 1) * 2 * 2 * 2 - repeated_views(&plan));
    }

    /// Cells of the sweep over views that the sweep over points has too.
    fn repeated_views(plan: &Plan) -> usize {
        let of = |name: &str| plan.sweeps.iter().find(|sweep| sweep.name == name).expect("a sweep").cells.clone();
        let (points, views) = (of("points"), of("views"));
        8 * points.iter().filter(|(_, scene)| views.iter().any(|(_, other)| other == scene)).count()
    }

    #[test]
    fn epipolar_depths_are_for_paper_scpsfm_and_psfm_on_the_scenes_without_depths() {
        let plan = |depths: &[Depths]| Plan {
            sweeps: Sweep::paper().into_iter().filter(|sweep| sweep.name == "outliers").collect(),
            depths: depths.to_vec(),
            contestants: Contestant::ALL.to_vec(),
            seeds: 1,
            paper_width: 1.0,
        };
        let (none, epipolar) = (plan(&[Depths::None]).runs(), plan(&[Depths::Epipolar]).runs());
        assert_eq!((none.len(), epipolar.len()), (8 * 8, 8 * 5));
        for run in &epipolar {
            let settings = run.settings().expect("no oracle");
            assert!(settings.epipolar_depths && !matches!(settings.method, Method::Auto | Method::Geometry));
            assert!(none.iter().any(|other| other.scene == run.scene && other.contestant == run.contestant));
        }
        assert!(none.iter().filter_map(Run::settings).all(|settings| !settings.epipolar_depths));
        assert_eq!(plan(&[Depths::None, Depths::Epipolar]).runs().len(), none.len() + epipolar.len());
    }

    #[test]
    fn a_width_is_part_of_the_key_of_paper_and_of_nothing_else() {
        let scene = SceneOptions::default();
        let plan = |paper_width| Plan {
            sweeps: Vec::new(),
            depths: Vec::new(),
            contestants: Vec::new(),
            seeds: 1,
            paper_width,
        };
        for contestant in Contestant::ALL {
            let [quarter, whole] = [0.25, 1.0].map(|width| plan(width).run(&scene, Depths::Given, 0, contestant));
            assert_eq!(quarter.key() != whole.key(), contestant.is_paper(), "{}", contestant.name());
            let width = |run: &Run| run.settings().map(|settings| settings.network_width);
            let expected = if contestant.is_paper() { 1.0 } else { SolveSettings::DEFAULT_NETWORK_WIDTH };
            assert!(width(&whole).is_none_or(|width| width == expected), "{}", contestant.name());
            let read: Run = serde_json::from_str(&whole.key()).expect("its own text");
            assert_eq!(read, whole);
        }
    }
}
