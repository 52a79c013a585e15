"""What the menus of the scene's properties offer: identifier, name, tooltip."""

PRESETS = [
    ("draft", "Draft", "A first look: a fifth of the steps, a smaller field"),
    ("standard", "Standard", "Good quality in reasonable time"),
    ("high", "High", "Best quality; takes several times longer"),
]
# Numbered, as files that were saved before "automatic" was there hold the numbers.
MASK_MODES = [
    (
        "automatic",
        "Automatic",
        "Empty space where masks cut an object out of nearly all photos, else unknown",
        "NONE",
        2,
    ),
    ("ignore", "Unknown", "Nothing is learned from these pixels: for masks that hide people or reflections", "NONE", 0),
    (
        "empty",
        "Empty Space",
        "There is nothing along these rays: for masks around an object, on a turntable for instance",
        "NONE",
        1,
    ),
]
POSE_PRESETS = [
    ("fast", "Fast", "Smaller images and fewer features; for overlapping, sharp photos"),
    ("standard", "Standard", "For most captures"),
    ("robust", "Robust", "Tries harder where photos are not registered"),
]
UP = [
    ("auto", "Estimated", "Up as the photos were held"),
    ("x", "X", "The positive X axis of the scene becomes up"),
    ("-x", "-X", "The negative X axis of the scene becomes up"),
    ("y", "Y", "The positive Y axis of the scene becomes up"),
    ("-y", "-Y", "The negative Y axis of the scene becomes up"),
    ("z", "Z", "The positive Z axis of the scene becomes up"),
    ("-z", "-Z", "The negative Z axis of the scene becomes up"),
]
EXPORTS = [
    ("blend", "Blender (.blend)", "Cameras, points, mesh and materials as a Blender file of its own"),
    ("glb", "glTF (.glb)", "The mesh with its colors or texture, for game engines and the web"),
    ("usd", "USD (.usdc)", "The mesh and the cameras, for other 3D programs"),
    ("obj", "Wavefront (.obj)", "The mesh with its texture, for nearly everything"),
    ("ply", "Stanford (.ply)", "The mesh with colors, classes and instances"),
    ("stl", "STL (.stl)", "The bare surface, for 3D printers"),
    ("masks", "Class Masks", "Black and white pictures of each class, for each photo and for the texture"),
    ("transforms", "Cameras (transforms.json)", "The photos' cameras, for nerfstudio and Instant-NGP"),
    ("colmap", "Cameras (COLMAP)", "The photos' cameras and the sparse points as a COLMAP model"),
    ("onnx", "Field (.onnx)", "The trained field as a function of place and direction"),
    ("voxels", "Voxels (.npz)", "Density, color and class on a regular grid"),
    ("splats", "Gaussian Splats (.ply)", "The baked field as splats with classes; bake it first"),
    (
        "vdb",
        "OpenVDB (.vdb)",
        "The baked field as a volume with density, color and a grid for each class; bake it first",
    ),
]
TEXTURE_SIZES = [  # saved files hold their places in the list: new ones come last
    ("0", "None", "Vertex colors only"),
    ("1024", "1024", "1024 × 1024 pixels"),
    ("2048", "2048", "2048 × 2048 pixels"),
    ("4096", "4096", "4096 × 4096 pixels"),
    ("8192", "8192", "8192 × 8192 pixels"),
    ("16384", "16384", "16384 × 16384 pixels"),
    ("auto", "Automatic", "As many pixels as the photos show of the surface"),
]
SIDES = [
    ("top", "Plan", "From above"),
    ("front", "Front", "From the negative Y side"),
    ("right", "Right", "From the positive X side"),
    ("back", "Back", "From the positive Y side"),
    ("left", "Left", "From the negative X side"),
    ("bottom", "From Below", "From below, such as a ceiling"),
]
CAMERAS = [
    ("both", "Both", "One camera for each photo, and an animated one"),
    ("many", "One per Photo", "One camera for each photo, with the photo behind it"),
    ("animated", "Animated", "One camera that stands at each photo's place in turn"),
]
SPLITS = [
    ("none", "One", "One object"),
    ("classes", "One per Class", "One object for each class"),
    ("instances", "One per Instance", "One object for each connected thing of a class"),
]
PASSES = [
    ("rgb", "Color", "The photographed colors"),
    ("depth", "Depth", "Distance along the camera's axis, in world units (meters once the scale is known)"),
    ("semantic", "Labels", "The class of each pixel"),
    ("confidence", "Confidence", "How certain the class is"),
    ("normal", "Normal", "Surface direction"),
    ("unknown", "Unknown", "Share of the way that no photo shows"),
]
