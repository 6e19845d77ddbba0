//! Which intrinsics an adjustment frees, and what is known of them beforehand.

use super::intrinsics::{Intrinsics, Parameter};

/// What may be freed beside the focal length.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Extension {
    PrincipalPoint,
    Aspect,
    RadialK1,
    /// Each of the next two only with the one before: a later term of a series without the first means nothing.
    RadialK2,
    RadialK3,
    /// Only with the first radial term: what is off centre distorts only where it would distort in the centre
    /// (Brown 1966).
    Tangential,
}

impl Extension {
    pub const ALL: [Extension; 6] =
        [Self::PrincipalPoint, Self::Aspect, Self::RadialK1, Self::RadialK2, Self::RadialK3, Self::Tangential];

    /// What must be free for this one to be.
    pub fn needs(self) -> Option<Extension> {
        match self {
            Extension::RadialK2 | Extension::Tangential => Some(Extension::RadialK1),
            Extension::RadialK3 => Some(Extension::RadialK2),
            _ => None,
        }
    }

    /// The parameters that it frees.
    pub fn parameters(self) -> &'static [Parameter] {
        match self {
            Extension::PrincipalPoint => &[Parameter::PrincipalX, Parameter::PrincipalY],
            Extension::Aspect => &[Parameter::LogAspect],
            Extension::RadialK1 => &[Parameter::RadialK1],
            Extension::RadialK2 => &[Parameter::RadialK2],
            Extension::RadialK3 => &[Parameter::RadialK3],
            Extension::Tangential => &[Parameter::TangentialP1, Parameter::TangentialP2],
        }
    }

    /// Whether it bends rays, which no pinhole does.
    pub fn is_of_lens(self) -> bool {
        self.parameters().iter().any(|parameter| parameter.is_of_lens())
    }

    /// What it frees, in words.
    pub fn name(self) -> &'static str {
        match self {
            Extension::PrincipalPoint => "principal point",
            Extension::Aspect => "aspect",
            Extension::RadialK1 => "radial distortion",
            Extension::RadialK2 => "second radial term",
            Extension::RadialK3 => "third radial term",
            Extension::Tangential => "tangential distortion",
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum FocalLength {
    Held,
    /// One for all views.
    Shared,
    /// One of each view.
    PerView,
}

/// Which intrinsics are free. All but the focal length are shared by the views.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct IntrinsicsModel {
    focal: FocalLength,
    extensions: [bool; Extension::ALL.len()],
}

impl IntrinsicsModel {
    pub const FIXED: Self = Self { focal: FocalLength::Held, extensions: [false; Extension::ALL.len()] };
    pub const FOCAL: Self = Self { focal: FocalLength::Shared, ..Self::FIXED };
    pub const FOCAL_PER_VIEW: Self = Self { focal: FocalLength::PerView, ..Self::FIXED };

    /// The simplest model: a focal length for all views, or one of each view.
    pub fn focal(per_view: bool) -> Self {
        if per_view { Self::FOCAL_PER_VIEW } else { Self::FOCAL }
    }

    /// Every combination of extensions with focal lengths as this model has them, the simplest first.
    pub fn with_any_extensions(self) -> impl Iterator<Item = Self> {
        (0..1usize << Extension::ALL.len())
            .map(move |mask| Self { extensions: std::array::from_fn(|k| mask >> k & 1 == 1), ..self })
            .filter(|model| model.extensions().all(|extension| model.admits(extension)))
    }

    /// Whether every view has a focal length of its own that is free.
    pub fn is_per_view(self) -> bool {
        self.focal == FocalLength::PerView
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

    pub fn without(mut self, extension: Extension) -> Self {
        self.extensions[extension as usize] = false;
        self
    }

    /// The extensions that no other of this model needs.
    pub fn removable(self) -> impl Iterator<Item = Extension> {
        self.extensions().filter(move |one| self.extensions().all(|other| other.needs() != Some(*one)))
    }

    /// This model with everything freed beside the focal length.
    pub const fn with_all_extensions(self) -> Self {
        Self { extensions: [true; Extension::ALL.len()], ..self }
    }

    /// This model with the focal length held.
    pub fn without_focal(self) -> Self {
        Self { focal: FocalLength::Held, ..self }
    }

    /// This model of a pinhole.
    pub fn without_lens(mut self) -> Self {
        Extension::ALL.into_iter().filter(|one| one.is_of_lens()).for_each(|one| self.extensions[one as usize] = false);
        self
    }

    pub fn extensions(self) -> impl Iterator<Item = Extension> {
        Extension::ALL.into_iter().filter(move |extension| self.contains(*extension))
    }

    /// Parameters that are free and shared by the views, in the order of [`Parameter::ALL`].
    pub fn parameters(self) -> Vec<Parameter> {
        let focal = (self.focal == FocalLength::Shared).then_some(Parameter::LogFocal);
        focal
            .into_iter()
            .chain(self.extensions().flat_map(|extension| extension.parameters().iter().copied()))
            .collect()
    }

    /// What is free, in words.
    pub fn name(self) -> String {
        let focal = match self.focal {
            FocalLength::Held => None,
            FocalLength::Shared => Some("focal length"),
            FocalLength::PerView => Some("a focal length a view"),
        };
        let mut names: Vec<&str> = focal.into_iter().collect();
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
    pub const NONE: Self = Self { mean: [0.0; Parameter::COUNT], information: [0.0; Parameter::COUNT] };

    /// Adds knowledge of a parameter of which nothing was known.
    pub fn knowing(mut self, parameter: Parameter, mean: f64, sigma: f64, noise: f64) -> Self {
        self.mean[parameter as usize] = mean;
        self.information[parameter as usize] = (noise / sigma).powi(2);
        self
    }

    /// With a parameter known more precisely, its standard deviation smaller by this factor.
    pub fn narrowed(mut self, parameter: Parameter, factor: f64) -> Self {
        self.information[parameter as usize] *= factor.powi(2);
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

    /// What the parameters of a model of each camera group cost where they are.
    pub fn cost_of(priors: &[Self], model: IntrinsicsModel, intrinsics: &[Intrinsics]) -> f64 {
        let parameters = model.parameters();
        priors.iter().zip(intrinsics).map(|(prior, intrinsics)| prior.cost(&parameters, intrinsics)).sum()
    }

    /// What these parameters cost where they are.
    pub fn cost(&self, parameters: &[Parameter], intrinsics: &Intrinsics) -> f64 {
        let cost = |parameter: &Parameter| {
            self.information[*parameter as usize] * self.deviation(*parameter, intrinsics).powi(2)
        };
        parameters.iter().map(cost).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_count_and_name_what_they_free() {
        let radial = IntrinsicsModel::FOCAL.with(Extension::PrincipalPoint).with(Extension::RadialK1);
        assert_eq!(radial.name(), "focal length, principal point and radial distortion");
        assert_eq!(radial.parameters().len(), 4);
        assert_eq!(
            (IntrinsicsModel::FIXED.name(), IntrinsicsModel::FIXED.parameters()),
            ("nothing".to_owned(), vec![])
        );
        assert_eq!(IntrinsicsModel::FULL.parameters(), Parameter::ALL);
        for simplest in [IntrinsicsModel::FOCAL, IntrinsicsModel::FOCAL_PER_VIEW] {
            assert_eq!(simplest.with_any_extensions().count(), 28);
            assert_eq!(simplest.with_any_extensions().next(), Some(simplest));
        }
        let later = radial.with(Extension::RadialK2);
        assert_eq!(later.removable().collect::<Vec<_>>(), [Extension::PrincipalPoint, Extension::RadialK2]);
        assert_eq!(later.without(Extension::RadialK2), radial);
        let own = IntrinsicsModel::FOCAL_PER_VIEW.with(Extension::RadialK1);
        assert_eq!(own.name(), "a focal length a view and radial distortion");
        assert_eq!(own.parameters(), [Parameter::RadialK1]);
    }
}
