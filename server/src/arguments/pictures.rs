//! Options of the command line -> the style of pictures.

use clap::Args;
use clearway_tools::picture::PictureStyle;

/// The options for drawing pictures.
#[derive(Args)]
#[command(next_help_heading = "Pictures")]
pub struct PictureOptions {
    /// Edge of the map in a picture, in pixels; 800 if absent.
    #[arg(long, value_parser = clap::value_parser!(u32).range(16..=8192))]
    pixels: Option<u32>,
    /// Distance from the vehicle to the edge of the map, in metres; 30 if absent.
    #[arg(long, value_name = "METRES", value_parser = metres)]
    range: Option<f64>,
    /// Draw this channel, such as roughness, of the layers that have it; the classes if absent. The colours have the
    /// same values in all pictures of a layer.
    #[arg(long)]
    channel: Option<String>,
}

impl PictureOptions {
    /// The style of these options.
    pub fn style(&self) -> PictureStyle {
        let default = PictureStyle::default();
        let (pixels, range_m) = (self.pixels.unwrap_or(default.pixels), self.range.unwrap_or(default.range_m));
        PictureStyle { pixels, range_m, channel: self.channel.clone(), ..default }
    }

    /// The first of these options that is given.
    pub fn first_given(&self) -> Option<&'static str> {
        let Self { pixels, range, channel } = self;
        let options = [("--pixels", pixels.is_some()), ("--range", range.is_some()), ("--channel", channel.is_some())];
        options.into_iter().find(|(_, is_given)| *is_given).map(|(name, _)| name)
    }
}

fn metres(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| "not a number of metres".to_owned())?;
    if (0.1..=10_000.0).contains(&value) { Ok(value) } else { Err("0.1 to 10000 m is allowed".into()) }
}
