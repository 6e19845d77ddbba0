//! What is run: ways of giving depths, contestants, and which of them on which sweeps.

use serde::{Deserialize, Serialize};

use super::sweeps::Sweep;
use crate::domain::{Method, Prior, SolveSettings};
use crate::synthetic::SceneOptions;

/// How projective depths come to the contestants.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Depths {
    /// True up to noise, as in the paper's synthetic experiments.
    Given,
    /// None: image points alone, as real tracks come.
    None,
}

impl Depths {
    pub const ALL: [Depths; 2] = [Depths::Given, Depths::None];

    pub fn name(self) -> &'static str {
        match self {
            Depths::Given => "given",
            Depths::None => "none",
        }
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
    /// The paper's method, with the DAQ loss.
    Paper,
    /// The same without it.
    PaperWithoutDaq,
    /// Plain projective factorisation (Sturm & Triggs 1996) at the threshold that suits the scene best.
    Psfm,
    /// AUTO with the DAQ residual in neither losses nor scores.
    AutoWithoutDaq,
    AutoWithoutIrls,
    AutoWithoutConsistency,
    AutoWithoutRigidity,
    AutoWithoutUniform,
    /// AUTO with the network's prior and no other.
    NetworkAlone,
}

impl Contestant {
    /// AUTO and what is left of it: without the network it is GEOMETRY.
    pub const ABLATION: [Contestant; 8] = [
        Contestant::Auto,
        Contestant::Geometry,
        Contestant::AutoWithoutDaq,
        Contestant::AutoWithoutIrls,
        Contestant::AutoWithoutConsistency,
        Contestant::AutoWithoutRigidity,
        Contestant::AutoWithoutUniform,
        Contestant::NetworkAlone,
    ];
    /// The contestants of the paper's figure.
    pub const ALL: [Contestant; 6] = [
        Contestant::Oracle,
        Contestant::Auto,
        Contestant::Geometry,
        Contestant::Paper,
        Contestant::PaperWithoutDaq,
        Contestant::Psfm,
    ];

    pub fn name(self) -> &'static str {
        match self {
            Contestant::Oracle => "oracle",
            Contestant::Auto => "auto",
            Contestant::Geometry => "geometry",
            Contestant::Paper => "paper",
            Contestant::PaperWithoutDaq => "paper-without-daq",
            Contestant::Psfm => "psfm",
            Contestant::AutoWithoutDaq => "auto-without-daq",
            Contestant::AutoWithoutIrls => "auto-without-irls",
            Contestant::AutoWithoutConsistency => "auto-without-consistency",
            Contestant::AutoWithoutRigidity => "auto-without-rigidity",
            Contestant::AutoWithoutUniform => "auto-without-uniform",
            Contestant::NetworkAlone => "network-alone",
        }
    }

    /// Whether this contestant has anything to say of such a scene: the oracle knows pinholes only, and rigidity needs
    /// depths.
    pub fn takes_part(self, scene: &SceneOptions, depths: Depths) -> bool {
        match self {
            Contestant::Oracle => scene.radial_k1 == 0.0 && scene.zoom == 0.0,
            Contestant::AutoWithoutRigidity => depths == Depths::Given,
            _ => true,
        }
    }

    /// Priors that this contestant does without.
    fn excluded_priors(self) -> Vec<Prior> {
        match self {
            Contestant::AutoWithoutIrls => vec![Prior::Irls],
            Contestant::AutoWithoutConsistency => vec![Prior::Consistency],
            Contestant::AutoWithoutRigidity => vec![Prior::Rigidity],
            Contestant::AutoWithoutUniform => vec![Prior::Uniform],
            Contestant::NetworkAlone => Prior::ALL.into_iter().filter(|&prior| prior != Prior::Network).collect(),
            _ => Vec::new(),
        }
    }

    /// The settings that it solves with; `None` for the oracle, which does not solve.
    pub fn settings(self, seed: u64) -> Option<SolveSettings> {
        let (method, use_daq) = match self {
            Contestant::Oracle => return None,
            Contestant::Auto => (Method::Auto, true),
            Contestant::Geometry => (Method::Geometry, true),
            Contestant::Paper => (Method::Paper, true),
            Contestant::PaperWithoutDaq => (Method::Paper, false),
            Contestant::Psfm => (Method::Psfm, true),
            Contestant::AutoWithoutDaq => (Method::Auto, false),
            Contestant::AutoWithoutIrls
            | Contestant::AutoWithoutConsistency
            | Contestant::AutoWithoutRigidity
            | Contestant::AutoWithoutUniform
            | Contestant::NetworkAlone => (Method::Auto, true),
        };
        let excluded_priors = self.excluded_priors();
        Some(SolveSettings { method, use_daq, seed, excluded_priors, ..SolveSettings::default() })
    }
}

/// One scene given to one contestant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Run {
    /// The scene, its seed and whether depths are given included.
    pub scene: SceneOptions,
    pub contestant: Contestant,
}

impl Run {
    /// What makes a run the same as another: its own text.
    pub fn key(&self) -> String {
        // Plain data: serialisation cannot fail.
        serde_json::to_string(self).unwrap_or_default()
    }
}

/// Which part of everything is run.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    pub sweeps: Vec<Sweep>,
    pub depths: Vec<Depths>,
    pub contestants: Vec<Contestant>,
    pub seeds: u64,
}

impl Plan {
    /// Every run once, seed by seed, so that a stopped evaluation has all cells with fewer seeds.
    pub fn runs(&self) -> Vec<Run> {
        let mut seen = std::collections::HashSet::new();
        let mut runs = Vec::new();
        for seed in 0..self.seeds {
            for sweep in &self.sweeps {
                for &depths in &self.depths {
                    for (_, scene) in &sweep.cells {
                        for &contestant in &self.contestants {
                            if !contestant.takes_part(scene, depths) {
                                continue;
                            }
                            let run = Run { scene: cell_scene(scene, depths, seed), contestant };
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
        };
        let runs = plan.runs();
        let cells: usize = plan.sweeps.iter().map(|sweep| sweep.cells.len()).sum();
        // The centre of all sweeps (90 % outliers, .3 % noise) is in two.
        assert_eq!(runs.len(), (cells - 1) * 2 * 2 * 2 - repeated_views(&plan));
    }

    /// Cells of the sweep over views that the sweep over points has too.
    fn repeated_views(plan: &Plan) -> usize {
        let of = |name: &str| plan.sweeps.iter().find(|sweep| sweep.name == name).expect("a sweep").cells.clone();
        let (points, views) = (of("points"), of("views"));
        8 * points.iter().filter(|(_, scene)| views.iter().any(|(_, other)| other == scene)).count()
    }
}
