//! COLMAP's camera models and what is taken over of a camera: its size, and a focal length known beforehand.

use crate::domain::{FocalPrior, ImageSize};

/// Standard deviation of the logarithm of a focal length that COLMAP calls known. It comes from EXIF (whole
/// millimetres of some 4 to 50, a sensor width from a table) or from the user; COLMAP does not say which, and
/// stabilised or focus-breathing lenses add some per cent. A tenth keeps a wrong one from outweighing the images.
pub const PRIOR_SIGMA_LOG: f64 = 0.1;

/// One of COLMAP's camera models.
#[derive(Debug, PartialEq, Eq)]
pub struct Model {
    /// Number in binary files and databases.
    pub id: i64,
    /// Name in text files.
    pub name: &'static str,
    /// How many parameters it has.
    pub parameters: usize,
    /// Whether the solver fits a similar lens: its first parameter is the horizontal focal length on the optical axis
    /// of a perspective camera or of a fisheye with radial distortion.
    pub is_solved: bool,
}

const fn model(id: i64, name: &'static str, parameters: usize, is_solved: bool) -> Model {
    Model { id, name, parameters, is_solved }
}

/// Every model of COLMAP 4 (`src/colmap/sensor/models.h`).
pub const MODELS: [Model; 18] = [
    model(0, "SIMPLE_PINHOLE", 3, true),
    model(1, "PINHOLE", 4, true),
    model(2, "SIMPLE_RADIAL", 4, true),
    model(3, "RADIAL", 5, true),
    model(4, "OPENCV", 8, true),
    model(5, "OPENCV_FISHEYE", 8, true),
    model(6, "FULL_OPENCV", 12, true),
    model(7, "FOV", 5, false),
    model(8, "SIMPLE_RADIAL_FISHEYE", 4, true),
    model(9, "RADIAL_FISHEYE", 5, true),
    model(10, "THIN_PRISM_FISHEYE", 12, false),
    model(11, "RAD_TAN_THIN_PRISM_FISHEYE", 16, false),
    model(12, "SIMPLE_DIVISION", 4, true),
    model(13, "DIVISION", 5, true),
    model(14, "SIMPLE_FISHEYE", 3, true),
    model(15, "FISHEYE", 4, true),
    model(16, "EUCM", 6, false),
    model(17, "EQUIRECTANGULAR", 2, false),
];

impl Model {
    /// The model of this number.
    pub fn of_id(id: i64) -> Option<&'static Self> {
        MODELS.iter().find(|model| model.id == id)
    }

    /// The model of this name.
    pub fn of_name(name: &str) -> Option<&'static Self> {
        MODELS.iter().find(|model| model.name == name)
    }
}

/// A camera of a file.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    /// `None`: a model newer than these, of which only the size is known.
    pub model: Option<&'static Model>,
    pub size: ImageSize,
    pub focal_prior: Option<FocalPrior>,
}

impl Camera {
    /// A camera without a prior.
    ///
    /// # Errors
    /// A size that no image has.
    pub fn new(model: Option<&'static Model>, width: u64, height: u64) -> Result<Self, String> {
        let side = |side: u64| u32::try_from(side).ok().filter(|side| (1..=ImageSize::MAX_SIDE_PX).contains(side));
        match side(width).zip(side(height)) {
            Some((width_px, height_px)) => {
                Ok(Self { model, size: ImageSize { width_px, height_px }, focal_prior: None })
            }
            None => Err(format!("size {width} x {height} px is not within 1..={}", ImageSize::MAX_SIDE_PX)),
        }
    }

    /// Whether rays and pixels are related otherwise than the solver supposes.
    pub fn is_foreign(&self) -> bool {
        self.model.is_none_or(|model| !model.is_solved)
    }

    /// The camera with its first parameter as a focal length known beforehand; without, where the parameter makes no
    /// sense as one.
    pub fn knowing(mut self, first_parameter: Option<f64>) -> Self {
        let focal_px = first_parameter.filter(|focal_px| focal_px.is_finite() && *focal_px > 0.0);
        let usable = focal_px.filter(|_| !self.is_foreign());
        self.focal_prior = usable.map(|focal_px| FocalPrior { focal_px, sigma_log: PRIOR_SIGMA_LOG });
        self
    }
}
