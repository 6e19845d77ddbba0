//! The constants of the choice among heads, with their reasons. Figures: those of
//! [`ContinuationOptions`]; of single ablations over seeds 0 to 9.

use crate::network::head::ContinuationOptions;

options! {
    /// How many heads are optimised, how they differ, and when one is accepted.
    pub struct HeadOptions {
        /// Heads at most. In the median one is optimised to 97 % wrong tracks, and 12 at 98 %, where the best of 16
        /// still is not always right (20 scenes each).
        heads: usize = 16,
        /// Alpha at the end of the relaxation and the least that the consensus may set, in turn over the heads. The
        /// first is best where one head has to do; of hard scenes other values find what it does not.
        alphas: [(f64, f64); 4] = [(14.0, 10.0), (20.0, 20.0), (10.0, 10.0), (30.0, 20.0)],
        /// Standard deviation of the logarithm of the factor that reweights each view in the relaxation; the first head
        /// has all views alike. Without it, new network weights alone: F1 .80 for .864 at 98 %.
        view_scale_deviation: f64 = 0.7,
        /// Least number of kept tracks with which a head is accepted by rank alone. Any four tracks have rank 4, so
        /// that a few more say little; eight leave four to contradict.
        accepted_by_rank: usize = 8,
        /// The same where the DAQ residual is small, too: four tracks determine the cameras that e is measured of; they
        /// end the heads, but are never verified.
        accepted_by_daq: usize = 4,
        /// Residual of the consensus, as a share of what wrong tracks leave, below which it stands apart.
        separation: f64 = ContinuationOptions::DEFAULT.separation,
        /// DAQ residual below which a consensus can be that of one constant calibration. Right sets of eight and ten
        /// tracks leave .001 to .005, sets with one or two wrong ones in their place .5 and more, of rank 4 or nearly
        /// so: without this F1 is .99 at 95 and 96 %.
        daq_acceptable: f64 = 0.2,
        /// Weight of the DAQ residual in the choice, in tracks: a wrong set of about one residual more does not pay.
        daq_weight: f64 = 3.0,
    }
}
