//! Which intrinsics an adjustment frees, and what is known of them beforehand.

use super::intrinsics::Intrinsics;

/// An intrinsic as it is adjusted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Parameter {
    LogFocal,
    PrincipalX,
    PrincipalY,
    LogAspect,
    Radial,
    SecondRadial,
}

impl Parameter {
    pub const COUNT: usize = 6;
    /// In the order of their discriminants.
    pub const ALL: [Parameter; Self::COUNT] =
        [Self::LogFocal, Self::PrincipalX, Self::PrincipalY, Self::LogAspect, Self::Radial, Self::SecondRadial];
}

/// What may be freed beside the focal length.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Extension {
    PrincipalPoint,
    Aspect,
    Radial,
    /// Only with [`Extension::Radial`]: the second term of a series without the first means nothing.
    SecondRadial,
}

impl Extension {
    pub const ALL: [Extension; 4] = [Self::PrincipalPoint, Self::Aspect, Self::Radial, Self::SecondRadial];

    /// What must be free for this one to be.
    pub fn needs(self) -> Option<Extension> {
        (self == Extension::SecondRadial).then_some(Extension::Radial)
    }

    /// The parameters that it frees.
    pub fn parameters(self) -> &'static [Parameter] {
        match self {
            Extension::PrincipalPoint => &[Parameter::PrincipalX, Parameter::PrincipalY],
            Extension::Aspect => &[Parameter::LogAspect],
            Extension::Radial => &[Parameter::Radial],
            Extension::SecondRadial => &[Parameter::SecondRadial],
        }
    }

    /// What it frees, in words.
    pub fn name(self) -> &'static str {
        match self {
            Extension::PrincipalPoint => "principal point",
            Extension::Aspect => "aspect",
            Extension::Radial => "radial distortion",
            Extension::SecondRadial => "second radial term",
        }
    }
}

/// Which intrinsics are free.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct IntrinsicsModel {
    focal: bool,
    extensions: [bool; Extension::ALL.len()],
}

impl IntrinsicsModel {
    pub const FIXED: Self = Self { focal: false, extensions: [false; Extension::ALL.len()] };
    pub const FOCAL: Self = Self { focal: true, extensions: [false; Extension::ALL.len()] };
    #[cfg(test)]
    pub const FULL: Self = Self { focal: true, extensions: [true; Extension::ALL.len()] };

    /// Every combination of extensions with the focal length free, the simplest first.
    pub fn all() -> impl Iterator<Item = Self> {
        (0..1usize << Extension::ALL.len())
            .map(|mask| Self { focal: true, extensions: std::array::from_fn(|k| mask >> k & 1 == 1) })
            .filter(|model| model.extensions().all(|extension| model.admits(extension)))
    }

    /// Whether what an extension needs is free.
    pub fn admits(self, extension: Extension) -> bool {
        extension.needs().is_none_or(|needed| self.contains(needed))
    }

    pub fn contains(self, extension: Extension) -> bool {
        self.extensions[extension as usize]
    }

    /// This model with more freed.
    pub fn with(mut self, extension: Extension) -> Self {
        self.extensions[extension as usize] = true;
        self
    }

    /// This model with the focal length held.
    pub fn without_focal(self) -> Self {
        Self { focal: false, ..self }
    }

    /// Extensions that are free.
    pub fn extensions(self) -> impl Iterator<Item = Extension> {
        Extension::ALL.into_iter().filter(move |extension| self.contains(*extension))
    }

    /// Free parameters, in the order of [`Parameter::ALL`].
    pub fn parameters(self) -> Vec<Parameter> {
        let focal = self.focal.then_some(Parameter::LogFocal);
        focal
            .into_iter()
            .chain(self.extensions().flat_map(|extension| extension.parameters().iter().copied()))
            .collect()
    }

    /// What is free, in words.
    pub fn name(self) -> String {
        let mut names: Vec<&str> = self.focal.then_some("focal length").into_iter().collect();
        names.extend(self.extensions().map(Extension::name));
        match names.as_slice() {
            [] => "nothing".to_owned(),
            [only] => (*only).to_owned(),
            [first @ .., last] => format!("{} and {last}", first.join(", ")),
        }
    }
}

/// Gaussian knowledge of the intrinsics before any observation.
///
/// The cost of an adjustment is in squared image units: an observation of standard deviation `noise` has information
/// `1`, a parameter known to `sigma` has `noise^2 / sigma^2`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IntrinsicsPrior {
    /// In the form in which the parameter is adjusted; indexed by [`Parameter`].
    pub mean: [f64; Parameter::COUNT],
    /// 0: nothing is known.
    pub information: [f64; Parameter::COUNT],
}

impl IntrinsicsPrior {
    /// Nothing is known.
    pub const NONE: Self = Self { mean: [0.0; Parameter::COUNT], information: [0.0; Parameter::COUNT] };

    /// Adds knowledge of a parameter of which nothing was known.
    pub fn knowing(mut self, parameter: Parameter, mean: f64, sigma: f64, noise: f64) -> Self {
        self.mean[parameter as usize] = mean;
        self.information[parameter as usize] = (noise / sigma).powi(2);
        self
    }

    /// Without what is known of one parameter.
    pub fn forgetting(mut self, parameter: Parameter) -> Self {
        self.information[parameter as usize] = 0.0;
        self
    }

    /// Present minus expected value; 0 where nothing is known.
    pub fn deviation(&self, parameter: Parameter, intrinsics: &Intrinsics) -> f64 {
        match self.information[parameter as usize] > 0.0 {
            true => intrinsics.value(parameter) - self.mean[parameter as usize],
            false => 0.0,
        }
    }

    /// What the parameters of a model cost where they are.
    pub fn cost(&self, model: IntrinsicsModel, intrinsics: &Intrinsics) -> f64 {
        let cost =
            |parameter: Parameter| self.information[parameter as usize] * self.deviation(parameter, intrinsics).powi(2);
        model.parameters().into_iter().map(cost).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_count_and_name_what_they_free() {
        let radial = IntrinsicsModel::FOCAL.with(Extension::PrincipalPoint).with(Extension::Radial);
        assert_eq!(radial.name(), "focal length, principal point and radial distortion");
        assert_eq!(radial.parameters().len(), 4);
        assert_eq!(
            (IntrinsicsModel::FIXED.name(), IntrinsicsModel::FIXED.parameters()),
            ("nothing".to_owned(), vec![])
        );
        assert_eq!(IntrinsicsModel::FULL.parameters(), Parameter::ALL);
        assert_eq!(IntrinsicsModel::all().count(), 12);
        assert_eq!(IntrinsicsModel::all().next(), Some(IntrinsicsModel::FOCAL));
    }
}
