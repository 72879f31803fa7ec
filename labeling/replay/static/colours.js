// The colours of points and boxes, as shares of red, green and blue.

const clamp = (value) => Math.min(1, Math.max(0, value));

function hsv(hue, saturation, value) {
  const channel = (shift) => {
    const k = (shift + hue * 6) % 6;
    return value - value * saturation * Math.max(0, Math.min(k, 4 - k, 1));
  };
  return [channel(5), channel(3), channel(1)];
}

/** The hue is the direction, brightness and saturation the speed; as in the pictures of `render`. */
function colourOfVelocity(vx, vy) {
  const share = clamp(Math.hypot(vx, vy) / topSpeed) ** 0.6;
  return hsv((Math.atan2(vy, vx) / (2 * Math.PI) + 1) % 1, 0.15 + 0.75 * share, 0.6 + 0.4 * share);
}

const RAMP = [[0.19, 0.25, 0.5], [0.17, 0.53, 0.66], [0.29, 0.75, 0.54], [0.79, 0.85, 0.33], [0.96, 0.63, 0.29]];

function colourOfHeight(share) {
  const at = clamp(share) * (RAMP.length - 1);
  const low = Math.min(Math.floor(at), RAMP.length - 2);
  return RAMP[low].map((value, channel) => value + (at - low) * (RAMP[low + 1][channel] - value));
}

const colourOfTrack = (track) => hsv((track.number * 0.381966) % 1, 0.6, 0.95);
const colourOfScore = (score) => hsv(clamp(score) / 3, 0.75, 0.95);

function colourOfBox(track, box) {
  switch (byId("colour").value) {
    case "track": return colourOfTrack(track);
    case "score": return colourOfScore(box[SCORE]);
    default: return colourOfVelocity(box[VX], box[VY]);
  }
}

function colourPoints(points, header, sweep) {
  const by = byId("colour").value;
  const [low, high] = data.height_m;
  const numPoints = points.places.length / 3;
  const colours = new Uint8Array(3 * numPoints);
  const UNKNOWN = [0.85, 0.85, 0.85];
  for (let row = 0; row < numPoints; row++) {
    const height = clamp((points.places[3 * row + 2] - low) / (high - low));
    const moving = row - header.num_static;
    let colour;
    if (by === "height") {
      colour = colourOfHeight(height);
    } else if (moving < 0) {
      colour = [0.3 + 0.3 * height, 0.35 + 0.3 * height, 0.43 + 0.27 * height];
    } else if (by === "flow") {
      const isKnown = points.vx[moving] !== data.no_flow;
      colour = isKnown ? colourOfVelocity(points.vx[moving] * data.grid_mps, points.vy[moving] * data.grid_mps) : UNKNOWN;
    } else {
      const track = trackOfNumber.get(points.track[moving]);
      const box = track && track.boxOf.get(sweep);
      colour = !track ? UNKNOWN : by === "track" ? colourOfTrack(track) : box ? colourOfScore(box[SCORE]) : UNKNOWN;
    }
    for (let channel = 0; channel < 3; channel++) colours[3 * row + channel] = 255 * colour[channel];
  }
  return colours;
}
