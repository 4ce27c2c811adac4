// Gaussian splats in the 3D view, drawn by Spark (global SPARK), which sorts them in a worker and asks for a redraw.
// They are unpacked when they are first shown.
function addSplats({ packed, scene, renderer, redraw }) {
  let [splats, unpacked] = [null, null];
  const unpack = () => {
    // as they were fitted: widened by 0.3 pixels² without fading, sorted by depth, as far as alpha reaches 1/255
    const how = { preBlurAmount: 0.3, blurAmount: 0, sortRadial: false, maxStdDev: Math.sqrt(2 * Math.log(255)) };
    scene.add(new SPARK.SparkRenderer({ renderer, onDirty: redraw, ...how }));
    const fileBytes = Uint8Array.from(atob(packed), (c) => c.charCodeAt(0));
    splats = new SPARK.SplatMesh({ fileBytes, fileName: "model.spz" });
    scene.add(splats);
    return splats.initialized;
  };
  return {
    show(wanted) {
      if (wanted && !unpacked) unpacked = unpack().then(redraw);
      if (splats) splats.visible = wanted;
    },
    // Resolves once they can be drawn; at once where they are not wanted.
    ready: () => unpacked,
  };
}
